"""A router's access-control list, made from the table of topics.

Zenoh checks each message that arrives on a link (ingress) or leaves on one (egress). The certificate at the other end
identifies the process. Messages of the router's own process cross no link, and are not checked.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

from brakeline.messaging.bus.identity import role_of
from brakeline.messaging.bus.topic_keys import own_key
from brakeline.messaging.topics import BUNDLED, HEALTH, ROLES, SIMULATORS, TOPICS, Delivery

MOST_ROBOTS = 64  # of one process: a request batch holds as many
SHARED = ("actor", "safety")  # roles of which many processes may share a certificate with the role as its name, in pods
ALIVE = "alive/{source}"  # key of the liveliness token of a process
EVERYTHING = (
    *("put", "delete", "declare_subscriber", "query", "declare_queryable", "reply"),
    *("liveliness_token", "declare_liveliness_subscriber", "liveliness_query"),
)
INGRESS, EGRESS = "ingress", "egress"

Grant = tuple[str, tuple[str, ...], str]  # flow, messages, key expression


def access(names: Iterable[str], prefix: str) -> dict[str, Any]:
    """Return Zenoh's setting `access_control` for certificates with these names. It denies what it does not grant.

    Raises:
        ValueError: a name has no role.
    """
    rules, policies, subjects = [], [], []
    for name in names:
        granted = {f"{name} {i}": grant for i, grant in enumerate(grants(name, prefix))}
        rules += [
            {"id": rule, "permission": "allow", "flows": [flow], "messages": messages, "key_exprs": [key]}
            for rule, (flow, messages, key) in granted.items()
        ]
        subjects.append({"id": name, "cert_common_names": [name]})
        policies.append({"rules": list(granted), "subjects": [name]})
    return {
        "enabled": True,
        "default_permission": "deny",
        "rules": rules,
        "subjects": subjects,
        "policies": policies,
    }


def size_limits(prefix: str) -> list[dict[str, Any]]:
    """Return Zenoh's setting `low_pass_filter`: a router passes no message on that its topic does not allow."""
    limits: dict[int, list[str]] = {}
    for topic in TOPICS:
        if topic.delivery is not Delivery.QUERY:
            limits.setdefault(topic.largest, []).append(f"{prefix}/{topic.at()}")
    return [
        {"flows": ["ingress"], "messages": ["put"], "key_exprs": keys, "size_limit": largest}
        for largest, keys in limits.items()
    ]


def grants(name: str, prefix: str) -> list[Grant]:
    """Return the messages that a process of this name may send and receive."""
    role = role_of(name)
    if role == "router":  # it has an access-control list of its own, and forwards messages of others
        return [(flow, EVERYTHING, f"{prefix}/**") for flow in (INGRESS, EGRESS)]
    granted: list[Grant] = []
    for topic in TOPICS:
        everywhere = f"{prefix}/{topic.at()}"
        query = topic.delivery is Delivery.QUERY
        if role in topic.publishers and query:
            for key in _own(topic.key, name, shared=True):
                for at in (f"{prefix}/{key}", own_key(f"{prefix}/{key}", "*")):
                    granted += [(INGRESS, ("query",), at), (EGRESS, ("reply",), at)]
            granted += [(EGRESS, ("declare_queryable",), at) for at in (everywhere, own_key(everywhere, "*"))]
        elif role in topic.publishers:
            keys = _own(topic.key, name, shared=role in SHARED, robots=topic in BUNDLED) if topic.own else [topic.at()]
            granted += [(INGRESS, ("put",), f"{prefix}/{key}") for key in keys]
            granted.append((EGRESS, ("declare_subscriber",), everywhere))
        if role in topic.listeners and query:
            for key in (everywhere, own_key(everywhere, "*")):
                granted += [(INGRESS, ("declare_queryable", "reply"), key), (EGRESS, ("query",), key)]
        elif role in topic.listeners:
            granted += [(INGRESS, ("declare_subscriber",), everywhere), (EGRESS, ("put",), everywhere)]
    granted += [(INGRESS, ("liveliness_token",), f"{prefix}/{key}") for key in _own(ALIVE, name, shared=True)]
    if role in HEALTH.listeners:  # they may ask which processes are alive, too
        everyone = f"{prefix}/{ALIVE.format(source='*')}"
        granted.append((INGRESS, ("liveliness_query",), everyone))
        granted.append((EGRESS, ("liveliness_token", "reply"), everyone))
    return granted


def _own(key: str, name: str, shared: bool, robots: bool = False) -> list[str]:
    """Return the keys in which `{source}` is a name under which the process may speak.

    Exact names admit no key with a wildcard, which would reach the subscribers of many keys.

    Args:
        shared: admit all names that begin with this one and a dot, if the name is that of a role. Several processes
            may share such a certificate.
        robots: admit the names of the robots that an actor, or a learner with a batch, simulates.
    """
    sources = [name]
    if shared and name in ROLES:
        sources.append(f"{name}.$*")
    elif robots and role_of(name) in SIMULATORS:
        sources += [f"{name}.{number}" for number in range(MOST_ROBOTS)]
    elif name == "certify":
        sources.append("certify.adapt")  # the certifier of a run
    keys = [key.format(robot="*", source=source) for source in sources]
    return list(dict.fromkeys(keys))

"""Who may say and hear what, as a router's access-control list: the table of topics, and nothing else, is let through.

Zenoh looks at each message that comes from a link (ingress) or is about to leave on one (egress), and tells by the
certificate at the other end whose link it is. What a router's own process says does not cross a link and is not judged.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

from brakeline.messaging.bus.identity import role_of
from brakeline.messaging.bus.topic_keys import own_key
from brakeline.messaging.topics import HEALTH, TOPICS, Delivery, Topic

ALIVE = "alive/{source}"  # key of the token of each process that lives
EVERYTHING = (
    *("put", "delete", "declare_subscriber", "query", "declare_queryable", "reply"),
    *("liveliness_token", "declare_liveliness_subscriber", "liveliness_query"),
)
INGRESS, EGRESS = "ingress", "egress"

Grant = tuple[str, tuple[str, ...], str]  # flow, messages, key expression


def access(names: Iterable[str], prefix: str) -> dict[str, Any]:
    """Zenoh's `access_control` for certificates of these names: default deny, one policy a name.

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


def grants(name: str, prefix: str) -> list[Grant]:
    """What a process of that name may say and hear."""
    role = role_of(name)
    if role == "router":  # it judges by a list of its own, and what it passes on is others'
        return [(flow, EVERYTHING, f"{prefix}/**") for flow in (INGRESS, EGRESS)]
    found: list[Grant] = []
    for topic in TOPICS:
        everywhere = f"{prefix}/{topic.at()}"
        question = topic.delivery is Delivery.QUERY
        if role in topic.publishers and question:
            for key in (everywhere, own_key(everywhere, "*")):
                found += [(INGRESS, ("query",), key), (EGRESS, ("reply", "declare_queryable"), key)]
        elif role in topic.publishers:
            found += [(INGRESS, ("put",), key) for key in _published(topic, name, prefix)]
            found.append((EGRESS, ("declare_subscriber",), everywhere))
        if role in topic.listeners and question:
            for key in (everywhere, own_key(everywhere, "*")):
                found += [(INGRESS, ("declare_queryable", "reply"), key), (EGRESS, ("query",), key)]
        elif role in topic.listeners:
            found += [(INGRESS, ("declare_subscriber",), everywhere), (EGRESS, ("put",), everywhere)]
    found += [(INGRESS, ("liveliness_token",), f"{prefix}/{key}") for key in _own(ALIVE, name)]
    if role in HEALTH.listeners:  # who may hear how the others fare may know that they live
        everyone = f"{prefix}/{ALIVE.format(source='*')}"
        found.append((INGRESS, ("declare_liveliness_subscriber", "liveliness_query"), everyone))
        found.append((EGRESS, ("liveliness_token", "reply"), everyone))
    return found


def _published(topic: Topic, name: str, prefix: str) -> list[str]:
    keys = _own(topic.key, name) if topic.own else [topic.key.format(robot="*", source="*")]
    return [f"{prefix}/{key}" for key in keys]


def _own(key: str, name: str) -> list[str]:
    """A key where `{source}` is `name`, or begins with it and a dot."""
    sources = (name, f"{name}.$*") if "{source}" in key else ("",)
    return [key.format(robot="*", source=source) for source in sources]

"""What rmw_zenoh calls things: keys of topics, the tokens by which a node is seen in the ROS graph, QoS in a token.

topic   <domain>/<name without outer slashes>/<pkg>::msg::dds_::<Type>_/RIHS01_<hash>
token   @ros2_lv/<domain>/<session>/<node id>/<id>/<kind>/<enclave>/<namespace>/<node>
        and, of all but a node, /<topic>/<type>/<hash>/<qos>; every `/` inside a part is written `%`
"""

from __future__ import annotations

import re
from dataclasses import dataclass

NODE, PUBLISHER, SUBSCRIPTION = "NN", "MP", "MS"
SPACE = "@ros2_lv"
ANY_HASH = "*"  # a subscriber takes a type whatever its hash: Humble writes none, and what is no message is refused
DEPTH = 42  # of rmw_zenoh's default history, left out of a token
NAME = re.compile(r"[A-Za-z_][A-Za-z0-9_]*")
RELIABLE, BEST_EFFORT, TRANSIENT_LOCAL, VOLATILE = 1, 2, 1, 2  # as rmw numbers them


class BadRosName(ValueError):
    """Not a name that ROS takes."""


@dataclass(frozen=True)
class Qos:
    """Of a publisher or a subscription. latched: the last `depth` messages are kept for who comes later."""

    depth: int = 10
    reliable: bool = True
    latched: bool = False

    def token(self) -> str:
        """As a token's last part: what is rmw_zenoh's default is left out."""
        reliability = "" if self.reliable else str(BEST_EFFORT)
        durability = str(TRANSIENT_LOCAL) if self.latched else ""
        depth = "" if self.depth == DEPTH else str(self.depth)
        return f"{reliability}:{durability}:,{depth}:,:,:,,"


SENSOR = Qos(depth=5, reliable=False)  # ROS's profile of that name
LATCHED = Qos(depth=1, latched=True)


def full_name(name: str, namespace: str = "/", node: str = "") -> str:
    """A topic's name as it is in the graph: `scan` in `/robot1` is `/robot1/scan`; `~/tube` is below the node's own.

    Raises:
        BadRosName: a part of it is none.
    """
    if name.startswith("~/"):
        name = f"{node}/{name[2:]}"
    whole = name if name.startswith("/") else f"{namespace.rstrip('/')}/{name}"
    parts = whole.strip("/").split("/")
    if wrong := [part for part in parts if not NAME.fullmatch(part)]:
        raise BadRosName(f"{whole!r}: {wrong[0]!r} is no name in ROS: letters, digits and '_', not a digit first")
    return "/" + "/".join(parts)


def dds_type(kind: str) -> str:
    """`geometry_msgs/msg/Twist` as it stands in keys: `geometry_msgs::msg::dds_::Twist_`."""
    package, group, name = kind.split("/")
    return f"{package}::{group}::dds_::{name}_"


def ros_type(dds: str) -> str:
    """The inverse of `dds_type`."""
    package, group, _, name = dds.split("::")
    return f"{package}/{group}/{name.removesuffix('_')}"


def topic_key(domain: int, topic: str, kind: str, digest: str = ANY_HASH) -> str:
    """Where a topic (its full name) of that type is published."""
    return f"{domain}/{topic.strip('/')}/{dds_type(kind)}/{digest}"


@dataclass(frozen=True)
class GraphEntity:
    """A node, or a publisher or subscription of one, as a token tells of it. id: its own in the session, as `node_id`
    is its node's; topic, type, digest, qos: empty for a node."""

    domain: int
    session: str  # Zenoh's id of it
    node_id: int
    id: int
    kind: str
    namespace: str
    node: str
    topic: str = ""
    type: str = ""
    digest: str = ""
    qos: str = ""

    @property
    def token(self) -> str:
        """The key of the liveliness token."""
        ids = str(self.domain), self.session, str(self.node_id), str(self.id)
        parts = [SPACE, *ids, self.kind, "%", _mangled(self.namespace), self.node]
        if self.kind != NODE:
            parts += [_mangled(self.topic), dds_type(self.type), self.digest, self.qos]
        return "/".join(parts)

    @staticmethod
    def parse(token: str) -> GraphEntity:
        """Raises BadRosName: it is no token of a node, publisher or subscription."""
        parts = token.split("/")
        try:
            space, domain, session, node_id, own, kind, _, namespace, node, *topic = parts
            if space != SPACE or len(topic) != (0 if kind == NODE else 4):
                raise ValueError(kind)
            where = int(domain), session, int(node_id), int(own), kind, _plain(namespace), node
            if kind == NODE:
                return GraphEntity(*where)
            name, type_, digest, qos = topic
            return GraphEntity(*where, _plain(name), ros_type(type_), digest, qos)
        except ValueError as error:
            raise BadRosName(f"no token: {token!r}") from error


def _mangled(name: str) -> str:
    return name.replace("/", "%")


def _plain(name: str) -> str:
    return name.replace("%", "/")

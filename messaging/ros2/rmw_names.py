"""The conventions of rmw_zenoh: keys of topics, liveliness tokens that show nodes in the ROS graph, and attachments.

topic   <domain>/<name without outer slashes>/<pkg>::msg::dds_::<Type>_/RIHS01_<hash>
token   @ros2_lv/<domain>/<session>/<node id>/<id>/<kind>/<enclave>/<namespace>/<node>
        for a publisher or subscription followed by /<topic>/<type>/<hash>/<qos>; a `/` inside a part becomes `%`

rmw_zenoh sends an attachment with each message: sequence number, time and sender.
"""

from __future__ import annotations

import re
import struct
from dataclasses import dataclass

import xxhash

from brakeline.errors import BadRosName

NODE, PUBLISHER, SUBSCRIPTION = "NN", "MP", "MS"
SPACE = "@ros2_lv"
ANY_HASH = "*"  # a subscriber accepts any hash of its type: Humble has none, and invalid bytes are rejected anyway
DEFAULT_DEPTH = 42  # of rmw_zenoh's history; a token leaves it out
NAME = re.compile(r"[A-Za-z_][A-Za-z0-9_]*")
RELIABLE, BEST_EFFORT, TRANSIENT_LOCAL, VOLATILE = 1, 2, 1, 2  # numbers of rmw
ATTACHMENT = struct.Struct("<qqB16s")
GID = 16  # bytes


@dataclass(frozen=True)
class Qos:
    """Quality of service of a publisher or a subscription."""

    depth: int = 10  # messages in the history
    reliable: bool = True  # whether lost messages are sent again
    latched: bool = False  # whether later subscribers get the last `depth` messages

    def token(self) -> str:
        """Return the last part of a token, which leaves out the defaults of rmw_zenoh."""
        reliability = "" if self.reliable else str(BEST_EFFORT)
        durability = str(TRANSIENT_LOCAL) if self.latched else ""
        depth = "" if self.depth == DEFAULT_DEPTH else str(self.depth)
        return f"{reliability}:{durability}:,{depth}:,:,:,,"


SENSOR = Qos(depth=5, reliable=False)  # the sensor profile of ROS
LATCHED = Qos(depth=1, latched=True)
ALL_LATCHED = Qos(depth=100, latched=True)  # as tf2 subscribes to /tf_static: each publisher has a part


def full_name(name: str, namespace: str = "/", node: str = "") -> str:
    """Return a topic's full name: `scan` in `/robot1` is `/robot1/scan`; `~/tube` is below the node's name.

    Raises:
        BadRosName: a part of the name is not valid.
    """
    if name.startswith("~/"):
        name = f"{node}/{name[2:]}"
    whole = name if name.startswith("/") else f"{namespace.rstrip('/')}/{name}"
    parts = whole.strip("/").split("/")
    if invalid := [part for part in parts if not NAME.fullmatch(part)]:
        raise BadRosName(f"{whole!r}: {invalid[0]!r} is not a ROS name: use letters, digits, '_', and no digit first")
    return "/" + "/".join(parts)


def dds_type(kind: str) -> str:
    """Convert a type such as `geometry_msgs/msg/Twist` to its name in keys: `geometry_msgs::msg::dds_::Twist_`."""
    package, group, name = kind.split("/")
    return f"{package}::{group}::dds_::{name}_"


def topic_key(domain: int, topic: str, kind: str, digest: str = ANY_HASH) -> str:
    """Return the key of a topic (its full name) of one type."""
    return f"{domain}/{topic.strip('/')}/{dds_type(kind)}/{digest}"


@dataclass(frozen=True)
class GraphEntity:
    """A node, a publisher or a subscription in the graph."""

    domain: int
    session: str  # its Zenoh id
    # node_id, id: ids of the node and of the entity in the session
    node_id: int
    id: int
    kind: str
    namespace: str
    node: str
    # topic, type, digest, qos: empty for a node
    topic: str = ""
    type: str = ""
    digest: str = ""
    qos: str = ""

    @property
    def token(self) -> str:
        """The key of its liveliness token."""
        ids = str(self.domain), self.session, str(self.node_id), str(self.id)
        parts = [SPACE, *ids, self.kind, "%", _mangled(self.namespace), self.node]
        if self.kind != NODE:
            parts += [_mangled(self.topic), dds_type(self.type), self.digest, self.qos]
        return "/".join(parts)


def publishers_key(domain: int, topic: str) -> str:
    """Return the key expression of the tokens of all publishers of a topic (its full name), of any type."""
    return f"{SPACE}/{domain}/*/*/*/{PUBLISHER}/*/*/*/{_mangled(topic)}/**"


def publisher_of(token: str) -> tuple[str, str, str]:
    """Return session, node and type (`geometry_msgs::msg::dds_::Twist_`) of the token of a publisher.

    Raises:
        BadRosName: the key is no token of a publisher.
    """
    parts = token.split("/")
    if len(parts) != 13 or parts[5] != PUBLISHER:
        raise BadRosName(f"{token!r:.200} is no token of a publisher")
    namespace, node = parts[7].replace("%", "/").rstrip("/"), parts[8]
    return parts[2], f"{namespace}/{node}", parts[10]


def gid_of(token: str) -> bytes:
    """Return a publisher's global id: XXH3-128 of its liveliness token, low half first, each half little-endian."""
    return xxhash.xxh3_128_digest(token.encode())[::-1]


def attachment(sequence: int, time: int, gid: bytes) -> bytes:
    """Encode the attachment of a publisher's message, numbered from 1 on; `time` in ns since the Unix epoch."""
    return ATTACHMENT.pack(sequence, time, GID, gid)


def _mangled(name: str) -> str:
    return name.replace("/", "%")

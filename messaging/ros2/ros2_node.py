"""A node in a ROS 2 graph over Zenoh, by the conventions of rmw_zenoh, without ROS.

with Node(RosSettings(), "brakeline") as node:
    node.subscribe("scan", LaserScan, take, SENSOR)
    node.publisher("cmd_vel", Twist).put(twist(0.1, 0.0))
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any, Generic, Protocol, Self, TypeVar

import zenoh
from zenoh.ext import (
    CacheConfig,
    HistoryConfig,
    MissDetectionConfig,
    RecoveryConfig,
    declare_advanced_publisher,
    declare_advanced_subscriber,
)
from zenoh.handlers import RingChannel

from brakeline.errors import BadRosName, Malformed, Unreachable
from brakeline.messaging.bus.subscription import Subscription
from brakeline.messaging.bus.zenoh_sessions import as_bus_error, close_sessions, zenoh_config
from brakeline.messaging.rejected_messages import RejectedMessages
from brakeline.messaging.ros2.cdr_messages import decode, digest_of, encode, type_of
from brakeline.messaging.ros2.rmw_names import (
    NODE,
    PUBLISHER,
    SUBSCRIPTION,
    GraphEntity,
    Qos,
    attachment,
    dds_type,
    full_name,
    gid_of,
    publisher_of,
    publishers_key,
    topic_key,
)
from brakeline.messaging.steady_clock import steady_time_ns

M = TypeVar("M")
ROUTER = "tcp/localhost:7447"  # rmw_zenoh's default
RELIABLE = Qos()
LARGEST = 2**20  # bytes of a received message
MOST_WATCHED = 1000  # publishers of a topic


class MessageTap(Protocol):
    """Called with the bytes of every message that a node receives or sends, as a bag needs them."""

    def __call__(self, topic: str, kind: type, payload: bytes, at: int, qos: Qos) -> object:
        """at: ns since the Unix epoch."""


@dataclass(frozen=True)
class RosSettings:
    """How to reach a ROS graph.

    The node is a peer like those of rmw_zenoh: it connects to the router, and to the nodes that the router knows.
    """

    connect: tuple[str, ...] = (ROUTER,)  # Zenoh endpoints of the router
    listen: tuple[str, ...] = ()  # Zenoh endpoints on which the node is a router itself; empty: it is not
    # domain, namespace: of the node
    domain: int = 0
    namespace: str = "/"
    patience: float = 10.0  # s to wait for a router at the start

    def configuration(self) -> zenoh.Config:
        router = bool(self.listen)
        return zenoh_config(
            {
                "mode": "router" if router else "peer",
                "connect/endpoints": [] if router else self.connect,
                "connect/exit_on_failure": not router,
                "connect/timeout_ms": -1 if router else int(self.patience * 1e3),
                "listen/endpoints": self.listen if router else ["tcp/localhost:0"],
                "scouting/gossip/enabled": True,
                "timestamping/enabled": True,  # latched topics need it
            }
        )


class RosPublisher(Generic[M]):
    """A publisher of one type on one topic. count: messages sent so far."""

    def __init__(self, entity: GraphEntity, kind: type[M], qos: Qos, sender: Any, tap: MessageTap | None) -> None:
        self.entity, self.count = entity, 0
        self._kind, self._qos, self._sender, self._tap = kind, qos, sender, tap
        self._gid = gid_of(entity.token)
        self._lock = threading.Lock()

    def put(self, message: M) -> None:
        """Publish a message. A receiver that reads too slowly loses it, since this method never waits.

        Raises:
            TypeError: the message has another type than the topic; BusError: the node is closed.
        """
        if not isinstance(message, self._kind):
            raise TypeError(f"{self.entity.topic} carries {type_of(self._kind)}, not {type(message).__name__}")
        payload, now = encode(message), time.time_ns()
        with self._lock, as_bus_error(f"cannot publish on {self.entity.topic}"):
            self.count += 1
            self._sender.put(payload, attachment=attachment(self.count, now, self._gid))
        if self._tap is not None:
            self._tap(self.entity.topic, self._kind, payload, now, self._qos)


class PublisherWatch:
    """The other nodes that publish on a topic at the moment, by their liveliness tokens."""

    def __init__(self, session: str) -> None:
        """session: the Zenoh id of this node, whose own publishers do not count."""
        self._session = session
        self._lock = threading.Lock()
        self._types: dict[str, tuple[str, str]] = {}  # node and type, by token

    def take(self, sample: zenoh.Sample) -> None:
        """Handle a token that appears or disappears."""
        token = str(sample.key_expr)
        try:
            session, node, kind = publisher_of(token)
        except BadRosName:
            return
        with self._lock:
            if sample.kind == zenoh.SampleKind.DELETE:
                self._types.pop(token, None)
            elif session != self._session and len(self._types) < MOST_WATCHED:
                self._types[token] = node, kind

    def nodes(self) -> list[str]:
        with self._lock:
            return sorted({node for node, _ in self._types.values()})

    def of_other_type(self, kind: type) -> list[str]:
        """Return the names of these nodes if none of them publishes this type."""
        wanted = dds_type(type_of(kind))
        with self._lock:
            publishers = list(self._types.values())
        return [] if any(its == wanted for _, its in publishers) else sorted({node for node, _ in publishers})


class RosNode:
    """A node in the graph, until `close`.

    A message that its handler cannot handle is skipped, and counted in `rejected`.

    Raises:
        Unreachable: no router answered within `patience`, or the node cannot listen on an endpoint.
        BadRosName: the name or the namespace is not valid.
    """

    def __init__(self, settings: RosSettings, name: str, tap: MessageTap | None = None) -> None:
        self.settings, self.name = settings, name
        full_name(f"/{name}")  # raises BadRosName
        self.rejected = RejectedMessages()
        self._tap = tap
        self._lock = threading.Lock()
        self._tokens: list[Any] = []
        self._senders: list[Any] = []  # Zenoh closes a publisher that nothing refers to
        self._subscriptions: list[Subscription] = []
        self._watches: list[Any] = []
        try:
            self._session = zenoh.open(settings.configuration())
        except zenoh.ZError as error:
            if settings.listen:
                raise Unreachable(f"cannot listen on {', '.join(settings.listen)}") from error
            raise Unreachable(
                f"no Zenoh router at {', '.join(settings.connect)} within {settings.patience:.0f} s; start one "
                "(`ros2 run rmw_zenoh_cpp rmw_zenohd`, or `brakeline bridge-sim`), or check --router"
            ) from error
        self._zid = str(self._session.info.zid())
        self._declare(self._entity(NODE))

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self, timeout: float = 2.0) -> None:
        """Leave the graph. Return after `timeout` seconds even if the network hangs."""
        close_sessions([self._session], [one.join for one in self._subscriptions], timeout)

    def full_name(self, topic: str) -> str:
        """Return a topic's name in the graph. Raises BadRosName."""
        return full_name(topic, self.settings.namespace, self.name)

    def publisher(self, topic: str, kind: type[M], qos: Qos = RELIABLE) -> RosPublisher[M]:
        """Make a publisher. Raises BadRosName."""
        entity = self._entity(PUBLISHER, self.full_name(topic), kind, qos)
        options: dict[str, Any] = {
            "congestion_control": zenoh.CongestionControl.DROP,
            "express": True,
            "reliability": zenoh.Reliability.RELIABLE if qos.reliable else zenoh.Reliability.BEST_EFFORT,
        }
        key = topic_key(self.settings.domain, entity.topic, entity.type, entity.digest)
        if qos.latched:
            heartbeat: Any = partial(MissDetectionConfig, heartbeat=0.5)  # Any: its stubs want both kinds
            sender: Any = declare_advanced_publisher(
                self._session,
                key,
                cache=CacheConfig(max_samples=qos.depth),
                sample_miss_detection=heartbeat(),
                publisher_detection=True,
                **options,
            )
        else:
            sender = self._session.declare_publisher(key, **options)
        self._senders.append(sender)
        self._declare(entity)
        return RosPublisher(entity, kind, qos, sender, self._tap)

    def subscribe(self, topic: str, kind: type[M], handler: Callable[[M], None], qos: Qos = RELIABLE) -> Subscription:
        """Call a handler with every message, in a thread of its own; a slow handler misses the oldest messages.

        Invalid messages, and those at which the handler raises an error, are skipped. Raises BadRosName.
        """
        entity = self._entity(SUBSCRIPTION, self.full_name(topic), kind, qos)
        key = topic_key(self.settings.domain, entity.topic, entity.type)
        channel: Any = RingChannel(qos.depth)
        if qos.latched:
            recovery: Any = partial(RecoveryConfig, heartbeat=True)
            receiver: Any = declare_advanced_subscriber(
                self._session,
                key,
                channel,
                history=HistoryConfig(detect_late_publishers=True, max_samples=qos.depth),
                recovery=recovery(),
            )
        else:
            receiver = self._session.declare_subscriber(key, channel)

        def take(sample: zenoh.Sample) -> None:
            if len(sample.payload) > LARGEST:
                raise Malformed(f"{len(sample.payload)} bytes; a message has at most {LARGEST}")
            payload = sample.payload.to_bytes()
            if self._tap is not None:
                self._tap(entity.topic, kind, payload, steady_time_ns(), qos)
            handler(decode(kind, payload))

        subscription = Subscription(entity.topic, receiver, take, self.rejected)
        self._subscriptions.append(subscription)
        self._declare(entity)
        return subscription

    def other_publishers(self, topic: str) -> PublisherWatch:
        """Watch which other nodes publish on a topic, of any type. Raises BadRosName."""
        watch = PublisherWatch(self._zid)
        key = publishers_key(self.settings.domain, self.full_name(topic))
        self._watches.append(self._session.liveliness().declare_subscriber(key, watch.take, history=True))
        return watch

    def _entity(self, kind: str, topic: str = "", message: type | None = None, qos: Qos = RELIABLE) -> GraphEntity:
        with self._lock:
            id = len(self._tokens)
        of_topic = () if message is None else (topic, type_of(message), digest_of(message), qos.token())
        settings = self.settings
        return GraphEntity(settings.domain, self._zid, 0, id, kind, settings.namespace, self.name, *of_topic)

    def _declare(self, entity: GraphEntity) -> None:
        token = self._session.liveliness().declare_token(entity.token)
        with self._lock:
            self._tokens.append(token)

"""A node among other people's ROS 2 nodes, over Zenoh as rmw_zenoh does it, without ROS.

with Node(RosSettings(), "brakeline") as node:
    node.subscribe("scan", LaserScan, take, SENSOR)
    node.publisher("cmd_vel", Twist).put(twist(0.1, 0.0))
"""

from __future__ import annotations

import json
import logging
import threading
import time
from collections.abc import Callable, Iterable
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

from brakeline.messaging.bus.bus_errors import Malformed, Unreachable, as_bus_error
from brakeline.messaging.bus.subscription import Subscription
from brakeline.messaging.rejected_messages import RejectedMessages
from brakeline.messaging.ros2.cdr_messages import decode, digest_of, encode, type_of
from brakeline.messaging.ros2.rmw_attachment import Attachment, gid_of
from brakeline.messaging.ros2.rmw_names import (
    NODE,
    PUBLISHER,
    SPACE,
    SUBSCRIPTION,
    BadRosName,
    GraphEntity,
    Qos,
    full_name,
    topic_key,
)

log = logging.getLogger("brakeline.ros2")

M = TypeVar("M")
ROUTER = "tcp/localhost:7447"  # where rmw_zenoh's router listens, and its nodes look for it
RELIABLE = Qos()
LARGEST = 2**20  # bytes of a message that is listened to


class MessageTap(Protocol):
    """Is called with every message that a node hears or sends, as bytes: a bag."""

    def __call__(self, topic: str, kind: type, payload: bytes, at: int, qos: Qos) -> object:
        """at: ns since the Unix epoch."""


@dataclass(frozen=True)
class RosSettings:
    """Where the ROS graph is. Endpoints are written as Zenoh writes them.

    As rmw_zenoh's nodes: a peer that connects to the router on this machine, and by gossip to the nodes that the router
    knows. With `listen` it is the router itself. `patience` is how long it waits for a router at the start.
    """

    connect: tuple[str, ...] = (ROUTER,)
    listen: tuple[str, ...] = ()
    domain: int = 0
    namespace: str = "/"
    patience: float = 10.0  # s

    def configuration(self) -> zenoh.Config:
        """Of one session."""
        router = bool(self.listen)
        values: dict[str, object] = {
            "mode": "router" if router else "peer",
            "connect/endpoints": [] if router else self.connect,
            "connect/exit_on_failure": not router,
            "connect/timeout_ms": -1 if router else int(self.patience * 1e3),
            "connect/retry": {"period_init_ms": 100, "period_max_ms": 1000, "period_increase_factor": 1.5},
            "listen/endpoints": self.listen if router else ["tcp/localhost:0"],
            "scouting/multicast/enabled": False,
            "scouting/gossip/enabled": True,
            "timestamping/enabled": True,  # latched topics need it
            "transport/shared_memory/enabled": False,
            # With the default of 1 ms messages were lost on busy cores.
            "transport/link/tx/queue/congestion_control/drop/wait_before_drop": 20_000,
        }
        config = zenoh.Config()
        for key, value in values.items():
            config.insert_json5(key, json.dumps(value))
        return config


class RosPublisher(Generic[M]):
    """Publishes messages of one type on one topic."""

    def __init__(self, entity: GraphEntity, kind: type[M], qos: Qos, sender: Any, tap: MessageTap | None) -> None:
        self.entity, self.count = entity, 0
        self._kind, self._qos, self._sender, self._tap = kind, qos, sender, tap
        self._gid = gid_of(entity.token)
        self._lock = threading.Lock()

    def put(self, message: M) -> None:
        """Never waits for a receiver that does not drain: to it the message is lost.

        Raises:
            TypeError: not the topic's type; BusError: the node is closed.
        """
        if not isinstance(message, self._kind):
            raise TypeError(f"{self.entity.topic} carries {type_of(self._kind)}, not {type(message).__name__}")
        payload, now = encode(message), time.time_ns()
        with self._lock, as_bus_error(f"cannot publish on {self.entity.topic}"):
            self.count += 1
            attachment = Attachment(self.count, now, self._gid).encode()
            self._sender.put(payload, attachment=attachment)
        if self._tap is not None:
            self._tap(self.entity.topic, self._kind, payload, now, self._qos)


class RosNode:
    """A node of that name; it is in the graph until `close`.

    What its handlers can't handle is passed over, and counted in `rejected`.

    Raises:
        Unreachable: no router answered within `patience`, or an endpoint cannot be listened on.
        BadRosName: the name or the namespace is none.
    """

    def __init__(self, settings: RosSettings, name: str, tap: MessageTap | None = None) -> None:
        self.settings, self.name = settings, name
        full_name(f"/{name}")  # is it one?
        self.rejected = RejectedMessages()
        self._tap = tap
        self._lock = threading.Lock()
        self._tokens: list[Any] = []
        self._senders: list[Any] = []  # one that nobody holds would be gone
        self._subscriptions: list[Subscription] = []
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
        """Leave the graph. Returns after `timeout` s even if the network hangs."""
        closable: Any = self._session
        worker = threading.Thread(target=closable.close, name="ros2 close", daemon=True)
        worker.start()
        worker.join(timeout)
        if worker.is_alive():
            log.warning("the ROS 2 session did not close within %.1f s; leaving it", timeout)
            return
        for subscription in self._subscriptions:
            subscription.join(timeout)

    def full_name(self, topic: str) -> str:
        """The topic's name in the graph. Raises BadRosName."""
        return full_name(topic, self.settings.namespace, self.name)

    def publisher(self, topic: str, kind: type[M], qos: Qos = RELIABLE) -> RosPublisher[M]:
        """Raises BadRosName."""
        entity = self._entity(PUBLISHER, self.full_name(topic), kind, qos)
        options: dict[str, Any] = {
            "congestion_control": zenoh.CongestionControl.DROP,
            "express": True,
            "reliability": zenoh.Reliability.RELIABLE if qos.reliable else zenoh.Reliability.BEST_EFFORT,
        }
        key = topic_key(self.settings.domain, entity.topic, entity.type, entity.digest)
        if qos.latched:
            beat: Any = partial(MissDetectionConfig, heartbeat=0.5)  # Any: its stubs want both kinds
            sender: Any = declare_advanced_publisher(
                self._session,
                key,
                cache=CacheConfig(max_samples=qos.depth),
                sample_miss_detection=beat(),
                publisher_detection=True,
                **options,
            )
        else:
            sender = self._session.declare_publisher(key, **options)
        self._senders.append(sender)
        self._declare(entity)
        return RosPublisher(entity, kind, qos, sender, self._tap)

    def subscribe(self, topic: str, kind: type[M], handler: Callable[[M], None], qos: Qos = RELIABLE) -> Subscription:
        """Call `handler` with every message, in a thread of its own; one that is slow misses the oldest.

        What is no message of that type is passed over, as is one at which the handler raises. Raises BadRosName.
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
                self._tap(entity.topic, kind, payload, time.time_ns(), qos)
            handler(decode(kind, payload))

        subscription = Subscription(entity.topic, receiver, take, self.rejected)
        self._subscriptions.append(subscription)
        self._declare(entity)
        return subscription

    def graph(self, timeout: float = 1.0) -> tuple[GraphEntity, ...]:
        """Every node, publisher and subscription of the domain that is there now, this node's too."""
        found = []
        where = f"{SPACE}/{self.settings.domain}/**"
        replies: Iterable[zenoh.Reply] = self._session.liveliness().get(where, timeout=timeout)
        for reply in replies:
            if reply.ok is not None:
                try:
                    found.append(GraphEntity.parse(str(reply.ok.key_expr)))
                except BadRosName:
                    continue  # a service's, or one that is none
        return tuple(found)

    def _entity(self, kind: str, topic: str = "", message: type | None = None, qos: Qos = RELIABLE) -> GraphEntity:
        with self._lock:
            own = len(self._tokens)
        of_topic = () if message is None else (topic, type_of(message), digest_of(message), qos.token())
        settings = self.settings
        return GraphEntity(settings.domain, self._zid, 0, own, kind, settings.namespace, self.name, *of_topic)

    def _declare(self, entity: GraphEntity) -> None:
        token = self._session.liveliness().declare_token(entity.token)
        with self._lock:
            self._tokens.append(token)

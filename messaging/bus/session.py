"""A process's place on the bus: its publishers, subscribers, questions and answers, and who is alive, over Zenoh.

Each client holds two sessions, one for telemetry and one for queries: a full telemetry queue blocks its link's
receiving thread, and a robot's safety query must never wait behind it.

Threads are Zenoh's, so open a bus only after a process was forked (or start processes by spawning).
"""

from __future__ import annotations

import logging
import secrets
import threading
from collections.abc import Callable, Iterable
from typing import Any, Self

import zenoh
from zenoh.handlers import FifoChannel, RingChannel

from brakeline.messaging.bus.access_control import ALIVE
from brakeline.messaging.bus.bus_settings import BusSettings, open_session
from brakeline.messaging.bus.publisher import Publisher
from brakeline.messaging.bus.query_client import QueryClient
from brakeline.messaging.bus.query_server import QueryServer
from brakeline.messaging.bus.subscription import Listener, ReceiverThreads, Sample, Subscription
from brakeline.messaging.bus.topic_keys import exact_key, key_of, own_key
from brakeline.messaging.message_checks import NAME
from brakeline.messaging.rejected_messages import RejectedMessages
from brakeline.messaging.topics import Delivery, Topic

log = logging.getLogger("brakeline.bus")

# Beyond FIFO the link blocks and with it the publisher; beyond RING the oldest message is dropped.
FIFO = 16384
RING = 64


class Bus:
    """A process's place on the bus, under the name `source`; it is alive to others until `close`.

    What its handlers can't handle is passed over, and counted in `rejected`.

    Raises:
        Unreachable: no router answered within `patience`, or an endpoint cannot be listened on.
        ValueError: no endpoint, or a name that cannot be part of a key.
        Insecure, BadKeys: no keys where there must be some, or not those of `source`.
    """

    def __init__(self, settings: BusSettings, source: str) -> None:
        if not NAME.fullmatch(source):
            raise ValueError(f"{source!r} cannot be the name of a process: letters, digits, '_', '.' and '-' only")
        self.settings = settings
        self.source = source
        self.run = secrets.randbits(63)
        self.rejected = RejectedMessages()
        self._lock = threading.Lock()
        self._publishers: dict[str, Publisher] = {}
        self._subscriptions: list[ReceiverThreads] = []
        self._telemetry = open_session(settings, source)
        # A router is one session; the two links of each client end in it separately.
        self._queries = self._telemetry if settings.listen else open_session(settings, source)
        self._asker = QueryClient(self._queries)
        self._token = self._telemetry.liveliness().declare_token(self._full(ALIVE.format(source=source)))

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self, timeout: float = 2.0) -> None:
        """Send what waits, say goodbye, end the handlers. Returns after `timeout` s even if the network hangs."""
        worker = threading.Thread(target=self._close_sessions, name="bus close", daemon=True)
        worker.start()
        worker.join(timeout)
        if worker.is_alive():
            log.warning("the bus did not close within %.1f s; leaving it", timeout)
            return
        for subscription in self._subscriptions:
            subscription.join(timeout)

    @property
    def connected(self) -> bool:
        """Is there a link to anybody? A client without one waits for its router to come back."""
        return bool(self._telemetry.info.transports())

    def publisher(self, topic: Topic, **names: str) -> Publisher:
        """The publisher of `topic`; the same one for the same key. `source` is this bus's unless given.

        Raises:
            ValueError: a name is missing or unknown, or the topic is a query.
        """
        if topic.delivery is Delivery.QUERY:
            raise ValueError(f"{topic.name} is a question: use `ask`")
        names = {"source": self.source} | names
        key = exact_key(topic, names)
        block = topic.delivery is Delivery.BLOCK
        with self._lock:
            if key not in self._publishers:
                sender = self._telemetry.declare_publisher(
                    self._full(key),
                    encoding=zenoh.Encoding.APPLICATION_PROTOBUF,
                    congestion_control=zenoh.CongestionControl.BLOCK if block else zenoh.CongestionControl.DROP,
                )
                self._publishers[key] = Publisher(topic, key, names["source"], self.run, sender)
            return self._publishers[key]

    def published(self) -> dict[str, int]:
        """Messages put so far, per key."""
        with self._lock:
            return {key: publisher.count for key, publisher in self._publishers.items()}

    def subscribe(self, topic: Topic, handler: Callable[[Sample], None], **names: str) -> Listener:
        """Call `handler` with every sample of `topic`, in a thread of its own; names left out match any.

        A sample for which it raises is passed over, as is one with too many bytes or a key of nobody's. One that is
        slow delays the publisher of a BLOCK topic after `FIFO` samples, and misses the oldest of a DROP topic after
        `RING`.
        """
        channel: Any = FifoChannel(FIFO) if topic.delivery is Delivery.BLOCK else RingChannel(RING)
        key = key_of(topic, names)
        receiver: Any = self._telemetry.declare_subscriber(self._full(key), channel)
        listener = Listener(topic, key, receiver, self.settings.prefix, handler, self.rejected)
        self._keep(listener)
        return listener

    def serve(self, topic: Topic, handler: Callable[[bytes], bytes], **names: str) -> QueryServer:
        """Answer the questions of `topic`, one at a time and every asker's in turn, in a thread of its own.

        What the handler raises goes back to who asked as `Refused` (with the exception's `field`, if it has one) and is
        logged. A question whose asker waits no longer is dropped. Several processes may serve one topic: an asker's
        questions go to the one that answered first, and to another if that one is gone or late.
        """
        key = key_of(topic, names)
        shared = self._full(key)
        receivers = [
            self._queries.declare_queryable(at, FifoChannel(FIFO), complete=True)
            for at in (own_key(shared, self._queries.zid()), shared)
        ]
        service = QueryServer(key, receivers, handler, self.rejected)
        self._keep(service)
        return service

    def ask(self, topic: Topic, payload: bytes, timeout: float, **names: str) -> bytes:
        """The answer to a question, within `timeout` s.

        Raises:
            NoReply: nobody serves it; known at once, without waiting for the deadline.
            Late: the deadline passed.
            Refused: the service answered with an error.
            ValueError: a name is missing or unknown.
        """
        return self._asker.ask(self._full(exact_key(topic, names)), payload, timeout)

    def living(self, timeout: float = 1.0) -> frozenset[str]:
        """The sources that are alive now, this one included."""
        replies: Iterable[zenoh.Reply] = self._telemetry.liveliness().get(
            self._full(ALIVE.format(source="*")), timeout=timeout
        )
        return frozenset(str(reply.ok.key_expr).rsplit("/", 1)[1] for reply in replies if reply.ok is not None)

    def watch(self, handler: Callable[[str, bool], None]) -> Subscription:
        """Call `handler(source, alive)` for each source that is alive now, then whenever one comes or goes."""
        receiver = self._telemetry.liveliness().declare_subscriber(
            self._full(ALIVE.format(source="*")), FifoChannel(FIFO), history=True
        )

        def take(sample: zenoh.Sample) -> None:
            handler(str(sample.key_expr).rsplit("/", 1)[1], sample.kind == zenoh.SampleKind.PUT)

        watching = Subscription("alive/*", receiver, take, self.rejected)
        self._keep(watching)
        return watching

    def _full(self, key: str) -> str:
        return f"{self.settings.prefix}/{key}"

    def _keep(self, receiving: ReceiverThreads) -> None:
        with self._lock:
            self._subscriptions.append(receiving)

    def _close_sessions(self) -> None:
        closables: list[Any] = [self._queries, self._telemetry]  # Any: their stubs are untyped here
        for session in closables:
            session.close()  # which undeclares all that it declared; closing twice does nothing

"""A process on the bus: its publishers, subscriptions, queries and liveliness, over Zenoh.

A client has two Zenoh sessions, one for telemetry and one for queries. A full telemetry queue blocks the receiving
thread of its link, and a safety query must never wait for telemetry.

Zenoh starts threads: fork before you open a bus, or spawn processes.
"""

from __future__ import annotations

import os
import secrets
import threading
from collections.abc import Callable, Iterable
from functools import partial
from typing import Any, Self

import zenoh
from zenoh.handlers import FifoChannel, RingChannel

from brakeline.errors import BusError
from brakeline.messaging.bus.access_control import ALIVE
from brakeline.messaging.bus.bundling import BundlePublisher, Unbundler
from brakeline.messaging.bus.bus_settings import BusSettings, open_session
from brakeline.messaging.bus.publisher import Publisher
from brakeline.messaging.bus.query_client import QueryClient
from brakeline.messaging.bus.query_server import Answer, QueryServer
from brakeline.messaging.bus.subscription import Listener, ReceiverThreads, Sample
from brakeline.messaging.bus.topic_keys import exact_key, key_of, names_of, own_key
from brakeline.messaging.bus.zenoh_sessions import close_sessions
from brakeline.messaging.message_checks import NAME
from brakeline.messaging.rejected_messages import RejectedMessages
from brakeline.messaging.topics import BUNDLE, BUNDLED, Delivery, Topic

# A full FIFO queue blocks the link and its publisher; a full RING queue drops the oldest message.
FIFO = 16384
RING = 64


class Bus:
    """A process on the bus under the name `source`, alive for others until `close`.

    `rejected` counts the messages that the handlers cannot handle.

    Raises:
        Unreachable: no router answered within `patience`, or the process cannot listen on an endpoint.
        ValueError: there is no endpoint, or the name cannot be part of a key.
        BadKeys: keys are necessary, or `source` has none.
    """

    def __init__(self, settings: BusSettings, source: str) -> None:
        if not NAME.fullmatch(source):
            raise ValueError(f"{source!r} cannot be the name of a process: letters, digits, '_', '.' and '-' only")
        self.settings = settings
        self.source = source
        self.run = secrets.randbits(63)
        self._process = os.getpid()
        self.rejected = RejectedMessages()
        self._lock = threading.Lock()
        self._publishers: dict[str, Publisher] = {}
        self._bundles: dict[str, BundlePublisher] = {}  # by robot
        self._unbundlers: dict[str | None, Unbundler] = {}  # by robot; None: all robots
        self._subscriptions: list[ReceiverThreads] = []
        self._telemetry = open_session(settings, source)
        # A router is one session; the two links of each client end in it separately.
        self._queries = self._telemetry if settings.listen else open_session(settings, source, settings.query_lease)
        self._query_client = QueryClient(self._queries)
        # The session with the short lease has the token, so that a process that hangs counts as gone within seconds.
        self._token = self._queries.liveliness().declare_token(self._full(ALIVE.format(source=source)))

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self, timeout: float = 2.0) -> None:
        """Send waiting messages, leave, and end the handlers; return after `timeout` [s] even if the network hangs."""
        sessions = [*self._bundles.values(), self._queries, self._telemetry]
        close_sessions(sessions, [one.join for one in self._subscriptions], timeout)

    @property
    def connected(self) -> bool:
        """Whether there is a link. A client without one waits for its router."""
        return bool(self._telemetry.info.transports())

    def publisher(self, topic: Topic, *, bundled: bool = False, **names: str) -> Publisher:
        """Return the publisher of a topic, the same one for the same key.

        Args:
            bundled: whether its messages leave together with others of this process (messaging/bus/bundling.py).
            names: of the key; `source` is this process by default.

        Raises:
            ValueError: a name is missing or unknown, or the topic is a query.
        """
        if topic.delivery is Delivery.QUERY:
            raise ValueError(f"{topic.name} is a query: use `ask`")
        names = {"source": self.source} | names
        key = exact_key(topic, names)
        bundle = self._bundle(names["robot"]) if bundled else None
        with self._lock:
            if key not in self._publishers:
                send = self._sender(topic, key) if bundle is None else partial(bundle.add, key)
                self._publishers[key] = Publisher(topic, key, names["source"], self.run, send)
            return self._publishers[key]

    def _sender(self, topic: Topic, key: str) -> Callable[[bytes], None]:
        block = topic.delivery is Delivery.BLOCK
        return self._telemetry.declare_publisher(
            self._full(key),
            encoding=zenoh.Encoding.APPLICATION_PROTOBUF,
            congestion_control=zenoh.CongestionControl.BLOCK if block else zenoh.CongestionControl.DROP,
        ).put

    def _bundle(self, robot: str) -> BundlePublisher:
        if robot not in self._bundles:
            self._bundles[robot] = BundlePublisher(self.publisher(BUNDLE, robot=robot))
        return self._bundles[robot]

    def flush(self) -> None:
        """Send the bundled messages that wait. Raises BusError."""
        for bundle in list(self._bundles.values()):
            bundle.flush()

    def published(self) -> dict[str, int]:
        """Return the number of messages put so far, by key. Those in bundles count; bundles do not."""
        with self._lock:
            return {key: one.count for key, one in self._publishers.items() if one.topic is not BUNDLE}

    def subscribe(self, topic: Topic, handler: Callable[[Sample], None], **names: str) -> Listener:
        """Call a handler with every sample of a topic, in a thread of its own. A missing name matches any.

        Samples at which the handler raises an exception are rejected, as are samples that are too large or have an
        invalid key. A slow handler delays the publisher of a BLOCK topic after `FIFO` samples, and misses the oldest
        samples of a DROP topic after `RING`.
        """
        channel: Any = FifoChannel(FIFO) if topic.delivery is Delivery.BLOCK else RingChannel(RING)
        key = key_of(topic, names)
        receiver: Any = self._telemetry.declare_subscriber(self._full(key), channel)
        listener = Listener(topic, key, receiver, self.settings.prefix, handler, self.rejected)
        self._subscriptions.append(listener)
        if topic in BUNDLED:
            self._unbundle(listener, names)
        return listener

    def _unbundle(self, listener: Listener, names: dict[str, str]) -> None:
        """Let a listener hear the bundled messages of its topic, too. One subscription serves all topics of a robot."""
        robot = names.get("robot")
        known = robot in self._unbundlers
        unbundler = self._unbundlers.setdefault(robot, Unbundler(self.rejected))
        unbundler.add(listener.topic, names, listener.deliver)
        if not known:
            self.subscribe(BUNDLE, unbundler.take, **({} if robot is None else {"robot": robot}))

    def serve(self, topic: Topic, handler: Answer, **names: str) -> QueryServer:
        """Answer the queries of a topic, one at a time, of each client in turn, in a thread of its own.

        If the handler raises an exception, the client gets it as `Refused`, with the exception's `field`. A query whose
        deadline has passed is dropped. Several processes may serve one topic: the queries of a client go to the service
        that answered first, and to another one if that service is gone or late.

        Args:
            handler: gets the payload and the name of the asker, which with keys holds the certificate of that name.
        """
        key = key_of(topic, names)
        shared = self._full(key)
        receivers = [
            self._queries.declare_queryable(at, FifoChannel(FIFO), complete=True)
            for at in (own_key(shared, self._queries.zid()), shared)
        ]
        cut = len(self.settings.prefix) + 1

        def asker_in(key: str) -> str:
            return names_of(topic, key[cut:]).get("source", "")

        service = QueryServer(key, receivers, handler, asker_in, self.rejected)
        self._subscriptions.append(service)
        return service

    def ask(self, topic: Topic, payload: bytes, timeout: float, **names: str) -> bytes:
        """Return the answer to a query.

        Args:
            timeout: deadline [s].
            names: of the key; `source`, who asks, is this process by default.

        Raises:
            NoReply: there is no service. This error does not wait for the deadline.
            Late: the deadline passed.
            Refused: the service answered with an error.
            BusError: the bus is closed, or this process was forked after the bus was opened.
            ValueError: a name is missing or unknown.
        """
        if os.getpid() != self._process:  # Zenoh would wait for its threads for ever
            raise BusError("this process was forked after the bus was opened: open a bus, or a client, after the fork")
        names = {"source": self.source} | names
        return self._query_client.ask(self._full(exact_key(topic, names)), payload, timeout)

    def living(self) -> frozenset[str]:
        """Return the names of the processes that are alive now, with this one."""
        key = self._full(ALIVE.format(source="*"))
        replies: Iterable[zenoh.Reply] = self._queries.liveliness().get(key, timeout=1.0)
        names = (str(reply.ok.key_expr).rsplit("/", 1)[1] for reply in replies if reply.ok is not None)
        return frozenset(name for name in names if NAME.fullmatch(name))

    def _full(self, key: str) -> str:
        return f"{self.settings.prefix}/{key}"

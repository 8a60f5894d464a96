"""The bus: publishers, subscribers, questions and answers, and who is alive, over Zenoh.

A process that is given `listen` is a router; the others are clients of one of the `connect` endpoints. Each client
holds two sessions, one for telemetry and one for queries: a full telemetry queue blocks its link's receiving thread,
and a robot's safety query must never wait behind it.

Threads are Zenoh's, so open a bus only after a process was forked (or start processes by spawning).
"""

from __future__ import annotations

import json
import logging
import math
import re
import secrets
import threading
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from typing import Any, Self

import zenoh
from google.protobuf.message import DecodeError, Message
from zenoh.handlers import FifoChannel, RingChannel

from messaging import brakeline_pb2 as pb
from messaging.topics import Delivery, Topic

log = logging.getLogger("brakeline.bus")

# Beyond FIFO the link blocks and with it the publisher; beyond RING the oldest message is dropped.
FIFO = 16384
RING = 64
NAME = re.compile(r"[A-Za-z0-9_.-]+")
SOURCE = re.compile(r" at /\S+\.rs:\d+\.?")  # where in Zenoh's source an error arose


class BusError(Exception):
    """Something went wrong between processes."""


class Unreachable(BusError):
    """No router answered at any endpoint, or an endpoint cannot be listened on."""


class NoReply(BusError):
    """Nobody serves this question, or who served it went away."""


class Late(BusError):
    """The deadline passed without an answer."""


class Malformed(BusError):
    """The bytes are not a message of the topic's type."""


class Refused(BusError):
    """The service answered with an error: its `type`, the `field` that is wrong (or empty) and `text`."""

    def __init__(self, error: pb.Error) -> None:
        super().__init__(f"{error.type}: {error.message}")
        self.type, self.field, self.text = error.type, error.field, error.message


@dataclass(frozen=True)
class BusSettings:
    """Where the bus is. Endpoints are written as Zenoh writes them: `tcp/127.0.0.1:7447`, `unixsock-stream//tmp/bus`.

    A client takes the first of `connect` that answers. `patience` is how long it waits for one at the start;
    once connected it reconnects by itself for ever. A peer that is silent for `lease` counts as gone.
    """

    connect: tuple[str, ...] = ()
    listen: tuple[str, ...] = ()
    prefix: str = "brakeline"
    patience: float = 10.0  # s
    lease: float = 1.5  # s
    stall: float = 1.0  # s, the longest a publisher waits for a receiver that does not drain, before the link is closed


def configuration(settings: BusSettings) -> zenoh.Config:
    """The Zenoh configuration of one session.

    Raises:
        ValueError: neither `connect` nor `listen` is given.
    """
    if not (settings.connect or settings.listen):
        raise ValueError("a bus needs an endpoint: `connect` to a router, or `listen` to be one")
    client = not settings.listen
    values: dict[str, object] = {
        "mode": "client" if client else "router",
        "connect/endpoints": settings.connect,
        "connect/exit_on_failure": client,
        "connect/timeout_ms": int(settings.patience * 1e3) if client else -1,
        "connect/retry": {"period_init_ms": 100, "period_max_ms": 1000, "period_increase_factor": 1.5},
        "listen/endpoints": settings.listen,
        "scouting/multicast/enabled": False,
        "scouting/gossip/enabled": False,
        # With it, queries were lost silently when a receiver stalled.
        "transport/shared_memory/enabled": False,
        "transport/link/tx/lease": int(settings.lease * 1e3),
        "transport/link/tx/queue/congestion_control/block/wait_before_close": int(settings.stall * 1e6),
        # With the default of 1 ms, one query in 1000 was lost on two busy cores, and large messages on busy links.
        "transport/link/tx/queue/congestion_control/drop/wait_before_drop": 20_000,
    }
    config = zenoh.Config()
    for key, value in values.items():
        config.insert_json5(key, json.dumps(value))
    return config


@dataclass(frozen=True)
class Sample:
    """A message as it came from the wire."""

    topic: Topic
    key: str  # without the prefix
    payload: bytes
    received: int  # ns since the Unix epoch

    def message(self) -> Any:
        """The payload, decoded as the topic's type.

        Raises:
            Malformed: it is not one.
        """
        try:
            return self.topic.message.FromString(self.payload)
        except DecodeError as error:
            raise Malformed(f"{self.key}: not a {self.topic.message.DESCRIPTOR.name}: {error}") from error


class Publisher:
    """Publishes one topic at one key, and numbers what it publishes."""

    def __init__(self, topic: Topic, key: str, source: str, run: int, sender: zenoh.Publisher) -> None:
        self.topic = topic
        self.key = key
        self.count = 0  # messages put so far: the last one's sequence
        self._source, self._run, self._sender = source, run, sender
        self._stamped = "header" in topic.message.DESCRIPTOR.fields_by_name
        self._lock = threading.Lock()

    def put(self, message: Message) -> None:
        """Fill in the message's header (all but `time`, which is the caller's), encode it once and send it.

        It is lost without an error while the router is away; the sequence then has a gap. It blocks for as long as
        `BusSettings.stall` if the topic's delivery is BLOCK and a receiver does not drain.

        Raises:
            TypeError: not the topic's type.
            BusError: the bus is closed.
        """
        if not isinstance(message, self.topic.message):
            raise TypeError(f"{self.key} carries {self.topic.message.__name__}, not {type(message).__name__}")
        with self._lock:  # sequence numbers leave in order
            if self._stamped:
                header: pb.Header = message.header  # type: ignore[attr-defined]
                header.sequence, header.source, header.run = self.count + 1, self._source, self._run
                header.wall_time = time.time_ns()
            with _typed(f"cannot publish at {self.key}"):
                self._sender.put(message.SerializeToString())
            self.count += 1


class Subscription:
    """A thread that hands samples, or questions, to a handler, one by one, until `close`."""

    def __init__(self, name: str, receiver: Any, work: Callable[[Any], None]) -> None:
        self._name, self._receiver, self._work = name, receiver, work
        self._complained = -1e9
        self._failures = 0
        self._thread = threading.Thread(target=self._run, name=f"bus {name}", daemon=True)
        self._thread.start()

    @property
    def failures(self) -> int:
        """How often the handler raised."""
        return self._failures

    def close(self) -> None:
        """Stop receiving, and wait for the sample in hand for a moment."""
        with _typed(f"closing {self._name}"):
            self._receiver.undeclare()
        self.join(1.0)

    def join(self, timeout: float) -> None:
        if self._thread is not threading.current_thread():
            self._thread.join(timeout)

    def _run(self) -> None:
        for item in self._receiver.handler:
            try:
                self._work(item)
            except Exception:
                self._failures += 1
                # Once a second: the line may come back over the bus to the handler that failed.
                if time.monotonic() - self._complained > 1.0:
                    self._complained = time.monotonic()
                    log.exception("handler of %s failed (%d times so far)", self._name, self._failures)


class Listener(Subscription):
    """A subscription that knows who fell silent."""

    def __init__(self, topic: Topic, key: str, receiver: Any, prefix: str, handler: Callable[[Sample], None]) -> None:
        self._topic, self._cut, self._handler = topic, len(prefix) + 1, handler
        self._heard: dict[str, float] = {}  # per key: when (time.monotonic) the latest sample came
        super().__init__(key, receiver, self._take)

    def stale(self) -> frozenset[str]:
        """Keys that were heard of, but for three periods of the topic's rate no more."""
        limit = math.inf if self._topic.stale_after is None else self._topic.stale_after
        now = time.monotonic()
        return frozenset(key for key, moment in self._heard.copy().items() if now - moment > limit)

    def _take(self, sample: zenoh.Sample) -> None:
        key = str(sample.key_expr)[self._cut :]
        self._heard[key] = time.monotonic()
        self._handler(Sample(self._topic, key, sample.payload.to_bytes(), time.time_ns()))


class Bus:
    """A process's place on the bus, under the name `source`; it is alive to others until `close`.

    Raises:
        Unreachable: no router answered within `patience`, or an endpoint cannot be listened on.
        ValueError: no endpoint, or a name that cannot be part of a key.
    """

    def __init__(self, settings: BusSettings, source: str) -> None:
        if not NAME.fullmatch(source):
            raise ValueError(f"{source!r} cannot be the name of a process: letters, digits, '_', '.' and '-' only")
        self.settings = settings
        self.source = source
        self.run = secrets.randbits(63)
        self._lock = threading.Lock()
        self._publishers: dict[str, Publisher] = {}
        self._queriers: dict[tuple[str, float], zenoh.Querier] = {}
        self._subscriptions: list[Subscription] = []
        self._telemetry = _open(settings)
        # A router is one session; the two links of each client end in it separately.
        self._queries = self._telemetry if settings.listen else _open(settings)
        self._token = self._telemetry.liveliness().declare_token(self._full(f"alive/{source}"))

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
        key = _exact(topic, names)
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

        A handler that raises is logged and goes on with the next sample. One that is slow delays the publisher of a
        BLOCK topic after `FIFO` samples, and misses the oldest of a DROP topic after `RING`.
        """
        channel: Any = FifoChannel(FIFO) if topic.delivery is Delivery.BLOCK else RingChannel(RING)
        key = _key(topic, names)
        receiver: Any = self._telemetry.declare_subscriber(self._full(key), channel)
        listener = Listener(topic, key, receiver, self.settings.prefix, handler)
        self._keep(listener)
        return listener

    def serve(self, topic: Topic, handler: Callable[[bytes], bytes], **names: str) -> Subscription:
        """Answer the questions of `topic`, one at a time, in a thread of its own.

        What the handler raises goes back to who asked as `Refused` (with the exception's `field`, if it has one) and is
        logged. Several processes may serve one topic: a question goes to one of them, and to another if that one is
        gone.
        """
        key = _key(topic, names)
        receiver = self._queries.declare_queryable(self._full(key), FifoChannel(FIFO), complete=True)
        return self._keep(Subscription(key, receiver, partial(_answer, handler)))

    def ask(self, topic: Topic, payload: bytes, timeout: float, **names: str) -> bytes:
        """The answer to a question, within `timeout` s.

        Raises:
            NoReply: nobody serves it; known at once, without waiting for the deadline.
            Late: the deadline passed.
            Refused: the service answered with an error.
            ValueError: a name is missing or unknown.
        """
        key = _exact(topic, names)
        refusal: Refused | None = None
        late = False
        with _typed(f"cannot ask {key}"):
            for reply in self._querier(key, timeout).get(payload=payload):
                if reply.ok is not None:
                    return reply.ok.payload.to_bytes()
                assert reply.err is not None
                if reply.err.encoding == zenoh.Encoding.APPLICATION_PROTOBUF:
                    refusal = Refused(pb.Error.FromString(reply.err.payload.to_bytes()))
                else:  # Zenoh's own error reply: its timer ran out
                    late = True
        if refusal is not None:
            raise refusal
        if late:
            raise Late(f"no answer to {key} within {timeout * 1e3:.0f} ms")
        raise NoReply(f"nobody answers {key}: is the service running, and on the same bus?")

    def living(self, timeout: float = 1.0) -> frozenset[str]:
        """The sources that are alive now, this one included."""
        replies: Iterable[zenoh.Reply] = self._telemetry.liveliness().get(self._full("alive/*"), timeout=timeout)
        return frozenset(str(reply.ok.key_expr).rsplit("/", 1)[1] for reply in replies if reply.ok is not None)

    def watch(self, handler: Callable[[str, bool], None]) -> Subscription:
        """Call `handler(source, alive)` for each source that is alive now, then whenever one comes or goes."""
        receiver = self._telemetry.liveliness().declare_subscriber(
            self._full("alive/*"), FifoChannel(FIFO), history=True
        )

        def take(sample: zenoh.Sample) -> None:
            handler(str(sample.key_expr).rsplit("/", 1)[1], sample.kind == zenoh.SampleKind.PUT)

        return self._keep(Subscription("alive/*", receiver, take))

    def _full(self, key: str) -> str:
        return f"{self.settings.prefix}/{key}"

    def _keep(self, subscription: Subscription) -> Subscription:
        with self._lock:
            self._subscriptions.append(subscription)
        return subscription

    def _querier(self, key: str, timeout: float) -> zenoh.Querier:
        with self._lock:
            if (key, timeout) not in self._queriers:
                self._queriers[key, timeout] = self._queries.declare_querier(
                    self._full(key),
                    target=zenoh.QueryTarget.BEST_MATCHING,
                    consolidation=zenoh.ConsolidationMode.NONE,  # the first answer is the answer
                    timeout=timeout,
                    priority=zenoh.Priority.REAL_TIME,
                    congestion_control=zenoh.CongestionControl.DROP,  # never stall past the deadline
                    express=True,
                )
            return self._queriers[key, timeout]

    def _close_sessions(self) -> None:
        closables: list[Any] = [self._queries, self._telemetry]  # Any: their stubs are untyped here
        for session in closables:
            session.close()  # which undeclares all that it declared; closing twice does nothing


def _open(settings: BusSettings) -> zenoh.Session:
    try:
        return zenoh.open(configuration(settings))
    except zenoh.ZError as error:
        why = SOURCE.sub("", str(error))
        if settings.listen:
            raise Unreachable(f"cannot listen on {', '.join(settings.listen)}: {why}") from error
        raise Unreachable(
            f"no router at {', '.join(settings.connect)} within {settings.patience:.0f} s; start one there "
            f"(any process with --listen), or check --connect: {why}"
        ) from error


def _answer(handler: Callable[[bytes], bytes], query: zenoh.Query) -> None:
    """Answer one query; without an answer of some kind the service would look dead."""
    with query:
        try:
            query.reply(query.key_expr, handler(query.payload.to_bytes() if query.payload else b""), express=True)
        except Exception as error:
            refusal = pb.Error(type=type(error).__name__, field=str(getattr(error, "field", "")), message=str(error))
            query.reply_err(refusal.SerializeToString(), encoding=zenoh.Encoding.APPLICATION_PROTOBUF)
            raise


def _key(topic: Topic, names: dict[str, str]) -> str:
    """The topic's key without the prefix, wildcards where names are left out.

    Raises:
        ValueError: the topic's key has no such name, or a name cannot be part of a key.
    """
    for field, name in names.items():
        if f"{{{field}}}" not in topic.key and field != "source":
            raise ValueError(f"{topic.key} has no {field!r}")
        if not NAME.fullmatch(name):
            raise ValueError(f"{field}={name!r}: letters, digits, '_', '.' and '-' only")
    return topic.at(**names)


def _exact(topic: Topic, names: dict[str, str]) -> str:
    key = _key(topic, names)
    if "*" in key:
        raise ValueError(f"{topic.key}: give every name, not only {', '.join(names) or 'none'}")
    return key


@contextmanager
def _typed(what: str) -> Iterator[None]:
    try:
        yield
    except zenoh.ZError as error:
        raise BusError(f"{what}: {error}") from error

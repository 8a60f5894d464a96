"""Receive the samples of a topic, and check them."""

from __future__ import annotations

import threading
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import zenoh
from google.protobuf.message import DecodeError

from brakeline.errors import Implausible, Malformed
from brakeline.messaging.bus.stated_names import check_names
from brakeline.messaging.bus.topic_keys import names_of, sender_of
from brakeline.messaging.bus.zenoh_sessions import as_bus_error
from brakeline.messaging.message_checks import NAME, check
from brakeline.messaging.rejected_messages import RejectedMessages
from brakeline.messaging.steady_clock import steady_time_ns
from brakeline.messaging.topics import Topic

MOST_KEYS = 2048  # of one subscription; samples at further keys are rejected
MOST_KEYS_OF_ONE = 256  # of one identity, so that it cannot take the place of the others


@dataclass(frozen=True)
class Sample:
    """A message as it arrived."""

    topic: Topic
    key: str  # without the prefix
    payload: bytes
    received: int  # ns since the Unix epoch

    def message(self) -> Any:
        """Return the payload as the topic's type. Do not change it: every call returns the same object.

        Raises:
            Malformed: the payload is invalid, or names another robot or source than the key.
        """
        return self._decoded

    @cached_property
    def _decoded(self) -> Any:
        try:
            message = self.topic.message.FromString(self.payload)
            check(message, len(self.payload))
            check_names(names_of(self.topic, self.key), message)
        except (DecodeError, Implausible) as error:
            raise Malformed(f"{self.key}: not a {self.topic.message.DESCRIPTOR.name}: {error}") from error
        return message


class ReceiverThreads:
    """Threads that read from receivers until `close`."""

    def __init__(self, name: str, receivers: Sequence[Any], runs: Sequence[Callable[[], None]]) -> None:
        """Start a thread for each of the functions `runs`, which end when their receiver is closed."""
        self._name, self._receivers = name, receivers
        self._threads = [threading.Thread(target=run, name=f"bus {name}", daemon=True) for run in runs]
        for thread in self._threads:
            thread.start()

    def close(self) -> None:
        """Stop receiving, and wait up to a second for the handler."""
        with as_bus_error(f"closing {self._name}"):
            for receiver in self._receivers:
                receiver.undeclare()
        self.join(1.0)

    def join(self, timeout: float) -> None:
        for thread in self._threads:
            if thread is not threading.current_thread():
                thread.join(timeout)


class Subscription(ReceiverThreads):
    """A thread that calls a handler with each sample until `close`."""

    def __init__(self, name: str, receiver: Any, work: Callable[[Any], None], rejected: RejectedMessages) -> None:
        self._samples, self._work, self._rejected = receiver.handler, work, rejected
        super().__init__(name, [receiver], [self._run])

    def _run(self) -> None:
        for item in self._samples:
            with self._rejected.skip_on_error(self._name):
                self._work(item)


class Listener(Subscription):
    """A subscription that checks samples."""

    def __init__(
        self,
        topic: Topic,
        key: str,
        receiver: Any,
        prefix: str,
        handler: Callable[[Sample], None],
        rejected: RejectedMessages,
    ) -> None:
        self.topic, self._prefix_length, self._handler = topic, len(prefix) + 1, handler
        self._delivering = threading.Lock()  # one thread delivers single samples, another one those of bundles
        self._keys_of: Counter[str] = Counter()  # by identity
        self._known: set[str] = set()  # keys
        super().__init__(key, receiver, self._take, rejected)

    def _take(self, sample: zenoh.Sample) -> None:
        key = str(sample.key_expr)[self._prefix_length :]
        self._check_size(key, len(sample.payload))  # before the copy of the payload
        self.deliver(key, sample.payload.to_bytes(), steady_time_ns())

    def deliver(self, key: str, payload: bytes, received: int) -> None:
        """Check a message, and call the handler with it. Raises Malformed."""
        self._check_size(key, len(payload))
        with self._delivering:
            if key not in self._known:
                self._admit(key)
            self._handler(Sample(self.topic, key, payload, received))

    def _check_size(self, key: str, size: int) -> None:
        if size > self.topic.largest:
            raise Malformed(f"{key[:200]}: {size} bytes; a message has at most {self.topic.largest}")

    def _admit(self, key: str) -> None:
        """Check a new key. Raises Malformed."""
        if not all(NAME.fullmatch(part) for part in key.split("/")):
            raise Malformed(f"{key[:200]!r} is no key of {self.topic.name}")
        if len(self._known) >= MOST_KEYS:
            raise Malformed(f"{key[:200]}: there are {MOST_KEYS} keys already: divide the robots among several buses")
        sender = sender_of(self.topic, key)
        if self._keys_of[sender] >= MOST_KEYS_OF_ONE:
            raise Malformed(
                f"{key[:200]}: {sender} publishes at {MOST_KEYS_OF_ONE} keys already: divide its robots among processes"
            )
        self._keys_of[sender] += 1
        self._known.add(key)

"""Who listens, and what is heard."""

from __future__ import annotations

import logging
import math
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import zenoh
from google.protobuf.message import DecodeError

from messaging.bus.errors import Malformed, typed
from messaging.topics import Topic

log = logging.getLogger("brakeline.bus")


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
        with typed(f"closing {self._name}"):
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

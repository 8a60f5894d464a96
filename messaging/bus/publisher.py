"""Who publishes one topic at one key."""

from __future__ import annotations

import threading
import time

import zenoh
from google.protobuf.message import Message

from brakeline.messaging import brakeline_pb2 as pb
from brakeline.messaging.bus.bus_errors import as_bus_error
from brakeline.messaging.topics import Topic


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
            with as_bus_error(f"cannot publish at {self.key}"):
                self._sender.put(message.SerializeToString())
            self.count += 1

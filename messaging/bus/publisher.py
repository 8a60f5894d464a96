"""Publish the messages of one topic at one key."""

from __future__ import annotations

import threading
from collections.abc import Callable

from google.protobuf.message import Message

from brakeline.messaging import brakeline_pb2 as pb
from brakeline.messaging.bus.zenoh_sessions import as_bus_error
from brakeline.messaging.steady_clock import steady_time_ns
from brakeline.messaging.topics import Topic


class Publisher:
    """A publisher of one topic at one key. It numbers its messages."""

    def __init__(self, topic: Topic, key: str, source: str, run: int, send: Callable[[bytes], None]) -> None:
        self.topic = topic
        self.key = key
        self.count = 0  # messages put so far; also the sequence number of the last one
        self._source, self._run, self._send = source, run, send
        self._stamped = "header" in topic.message.DESCRIPTOR.fields_by_name
        self._lock = threading.Lock()

    def put(self, message: Message) -> None:
        """Fill in the header of a message (except `time`, which the caller sets), and send it.

        Without a router the message is lost without an error; the sequence then has a gap. With BLOCK delivery and a
        slow receiver, the call blocks for up to `BusSettings.stall`.

        Raises:
            TypeError: the message has another type than the topic.
            BusError: the bus is closed.
        """
        if not isinstance(message, self.topic.message):
            raise TypeError(f"{self.key} carries {self.topic.message.__name__}, not {type(message).__name__}")
        with self._lock:  # sequence numbers leave in order
            if self._stamped:
                header: pb.Header = message.header  # type: ignore[attr-defined]
                header.sequence, header.source, header.run = self.count + 1, self._source, self._run
                header.wall_time = steady_time_ns()
            with as_bus_error(f"cannot publish at {self.key}"):
                self._send(message.SerializeToString())
            self.count += 1

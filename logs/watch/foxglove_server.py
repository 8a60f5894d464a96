"""Serves a running system to Foxglove: our messages and their pictures, on the channels that a log has."""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Collection
from types import TracebackType
from typing import Any, Self

import foxglove
from foxglove.websocket import ServerListener
from google.protobuf.message import Message
from mcap_protobuf.schema import build_file_descriptor_set

from brakeline.logs.foxglove import ROOT, FoxgloveConverter
from brakeline.logs.recorder import entry
from brakeline.logs.segment import Entry
from brakeline.logs.watch.websocket_gate import WebSocketGate, hidden_host
from brakeline.messaging.bus import Sample

RATE = 20.0  # pictures a second and robot
ORIGINS = ("https://app.foxglove.dev",)  # Foxglove in a browser


class FoxgloveServer:
    """A Foxglove server at `url`, from `with` to the end of the block. `take` is for one thread.

    Raises:
        OSError: on entering, when the port is taken.
    """

    def __init__(
        self, host: str = "127.0.0.1", port: int = 0, rate: float = RATE, origins: Collection[str] = ORIGINS
    ) -> None:
        """`port` 0: a free one; origins: of the pages that may connect; programs that are no browser always may."""
        self.host, self.port, self._origins = host, port, origins
        self._pictures = FoxgloveConverter(rate)
        self._context = foxglove.Context()
        self._channels: dict[str, foxglove.Channel] = {}
        self._schemas: dict[str, foxglove.Schema] = {}
        self._arenas: dict[str, Entry] = {}  # the latest of each: a viewer that comes later needs it too
        self._wanted: deque[str] = deque()

    def __enter__(self) -> Self:
        listener: Any = _Listener(self._wanted)
        hidden = hidden_host()
        self._server = foxglove.start_server(
            name="brakeline", host=hidden, port=0, context=self._context, server_listener=listener
        )
        try:
            self._gate = WebSocketGate(self.host, self.port, (hidden, self._server.port), self._origins)
        except OSError:
            self._server.stop()
            raise
        self.port = self._gate.port
        self.url = f"ws://{self.host}:{self.port}"
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, _: TracebackType | None) -> None:
        self._gate.close()
        self._server.stop()

    def take(self, sample: Sample) -> None:
        """Publish a message and what is drawn of it."""
        self._publish(entry(sample))
        for picture in self._pictures.from_sample(sample):
            if picture.key.startswith(f"{ROOT}/arena/"):
                self._arenas[picture.key] = picture
            self._publish(picture)

    def refresh(self) -> None:
        """Show the arenas to viewers that came since the last call."""
        while self._wanted:
            arena = self._arenas.get(self._wanted.popleft())
            if arena is not None:
                self._publish(arena)

    def _publish(self, one: Entry) -> None:
        if one.key not in self._channels:
            assert not isinstance(one.type, str), "what we publish has a schema"
            schema = self._schema(one.type)
            self._channels[one.key] = foxglove.Channel(
                one.key, message_encoding="protobuf", schema=schema, context=self._context
            )
        self._channels[one.key].log(one.payload, log_time=one.log_time)

    def _schema(self, kind: type[Message]) -> foxglove.Schema:
        name = kind.DESCRIPTOR.full_name
        if name not in self._schemas:
            data = build_file_descriptor_set(kind).SerializeToString()
            self._schemas[name] = foxglove.Schema(name=name, encoding="protobuf", data=data)
        return self._schemas[name]


class _Listener(ServerListener):
    """Notes, in the server's thread, which channels viewers begin to look at."""

    def __init__(self, wanted: deque[str]) -> None:
        self._wanted, self._lock = wanted, threading.Lock()

    def on_subscribe(self, client: Any, channel: Any) -> None:
        with self._lock:
            self._wanted.append(channel.topic)

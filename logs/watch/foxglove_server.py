"""Serve a running system to Foxglove: the messages and their scenes, on the same channels as in a log."""

from __future__ import annotations

from collections import deque
from collections.abc import Collection
from typing import Any, Self

import foxglove
from foxglove.websocket import ServerListener

from brakeline.logs.foxglove import ROOT, FoxgloveConverter
from brakeline.logs.recorder import entry as stored_entry
from brakeline.logs.segment import Entry, schema_of
from brakeline.logs.watch.websocket_gate import ORIGINS, WebSocketGate, hidden_host
from brakeline.messaging.bus import Sample

RATE = 20.0  # drawn steps per second and robot


class FoxgloveServer:
    """A Foxglove WebSocket server at `url`; a context manager. Call `publish` from one thread only.

    Raises:
        OSError: on entering, if the port is in use.
    """

    def __init__(self, host: str = "127.0.0.1", port: int = 0, origins: Collection[str] = ORIGINS) -> None:
        """Create a server.

        Args:
            port: 0 selects a free port.
            origins: web pages that may connect. Programs that are no browser can always connect.
        """
        self.host, self.port, self._origins = host, port, origins
        self._converter = FoxgloveConverter(RATE)
        self._context = foxglove.Context()
        self._channels: dict[str, foxglove.Channel] = {}
        self._arenas: dict[str, Entry] = {}  # the latest arena of each actor, for viewers that connect later
        self._subscribed: deque[str] = deque()

    def __enter__(self) -> Self:
        listener: Any = _Listener(self._subscribed)
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

    def __exit__(self, *_: object) -> None:
        self._gate.close()
        self._server.stop()

    def publish(self, sample: Sample) -> None:
        self._log(stored_entry(sample))
        for picture in self._converter.from_sample(sample):
            if picture.key.startswith(f"{ROOT}/arena/"):
                self._arenas[picture.key] = picture
            self._log(picture)

    def refresh(self) -> None:
        """Publish the arenas again for viewers that subscribed since the last call."""
        while self._subscribed:
            arena = self._arenas.get(self._subscribed.popleft())
            if arena is not None:
                self._log(arena)

    def _log(self, entry: Entry) -> None:
        if entry.key not in self._channels:
            assert not isinstance(entry.type, str), "every published message has a schema"
            name, data = entry.type.DESCRIPTOR.full_name, schema_of(entry.type)
            schema = foxglove.Schema(name=name, encoding="protobuf", data=data)
            self._channels[entry.key] = foxglove.Channel(
                entry.key, message_encoding="protobuf", schema=schema, context=self._context
            )
        self._channels[entry.key].log(entry.payload, log_time=entry.log_time)


class _Listener(ServerListener):
    """Records, in the server's thread, the channels that viewers subscribe to."""

    def __init__(self, subscribed: deque[str]) -> None:
        self._subscribed = subscribed

    def on_subscribe(self, client: Any, channel: Any) -> None:
        self._subscribed.append(channel.topic)

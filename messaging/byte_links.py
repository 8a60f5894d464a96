"""Links that carry bytes, by URL: what MAVLink runs over. Nothing here knows what the bytes mean.

udpin:HOST:PORT    listen; answer whoever sent something lately
udpout:HOST:PORT   send there first
tcp:HOST:PORT      connect
tcpin:HOST:PORT    listen; any number of connections
"""

from __future__ import annotations

import contextlib
import socket
import time
from typing import Protocol

from brakeline.errors import BadLink

FORGET = 10.0  # s of silence after which a UDP peer is no longer answered
LARGEST = 65536  # bytes read at once


class Link(Protocol):
    """Bytes there and back; what is lost on the way is lost."""

    def send(self, data: bytes) -> None:
        """Never waits; never raises for a peer that is gone."""

    def receive(self) -> bytes:
        """What has arrived since the last call; empty when nothing has."""

    def close(self) -> None: ...


class Udp:
    """A UDP socket that answers its peers: a fixed one, or all that were heard in the last `FORGET` seconds."""

    def __init__(self, host: str, port: int, listen: bool) -> None:
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.setblocking(False)
        self._fixed = None if listen else (socket.gethostbyname(host), port)
        self._peers: dict[tuple[str, int], float] = {}
        self._socket.bind((host, port) if listen else ("0.0.0.0" if host != "127.0.0.1" else host, 0))

    @property
    def port(self) -> int:
        """Its own."""
        return int(self._socket.getsockname()[1])

    def send(self, data: bytes) -> None:
        now = time.monotonic()
        peers = [self._fixed] if self._fixed else [peer for peer, heard in self._peers.items() if now - heard < FORGET]
        for peer in peers:
            with contextlib.suppress(OSError):
                self._socket.sendto(data, peer)

    def receive(self) -> bytes:
        parts: list[bytes] = []
        while True:
            try:
                data, peer = self._socket.recvfrom(LARGEST)
            except BlockingIOError:
                return b"".join(parts)
            except OSError:  # the peer's port is closed: the answer to something sent earlier
                continue
            self._peers[peer] = time.monotonic()
            parts.append(data)

    def close(self) -> None:
        self._socket.close()


class Tcp:
    """One TCP connection; after its end it carries nothing."""

    def __init__(self, connection: socket.socket) -> None:
        self._socket = connection
        self._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self._socket.setblocking(False)
        self.open = True

    def send(self, data: bytes) -> None:
        try:
            if self.open and self._socket.send(data) < len(data):
                self.open = False  # a peer that does not read: half a frame is worse than none
        except OSError:
            self.open = False

    def receive(self) -> bytes:
        parts: list[bytes] = []
        while self.open:
            try:
                data = self._socket.recv(LARGEST)
            except BlockingIOError:
                break
            except OSError:
                data = b""
            if not data:
                self.open = False
            parts.append(data)
        return b"".join(parts)

    def close(self) -> None:
        self._socket.close()


class TcpServer:
    """Accepts connections; all get what is sent."""

    def __init__(self, host: str, port: int) -> None:
        self._socket = socket.create_server((host, port))
        self._socket.setblocking(False)
        self._clients: list[Tcp] = []

    @property
    def port(self) -> int:
        """Its own."""
        return int(self._socket.getsockname()[1])

    def send(self, data: bytes) -> None:
        for client in self._clients:
            client.send(data)

    def receive(self) -> bytes:
        with contextlib.suppress(BlockingIOError):
            self._clients.append(Tcp(self._socket.accept()[0]))
        data = b"".join(client.receive() for client in self._clients)
        for client in [client for client in self._clients if not client.open]:
            client.close()
            self._clients.remove(client)
        return data

    def close(self) -> None:
        for client in self._clients:
            client.close()
        self._socket.close()


def open_link(url: str) -> Udp | Tcp | TcpServer:
    """The link of a URL.

    Raises:
        BadLink: not one of the four kinds.
        OSError: the port is taken, or nobody listens.
    """
    parts = url.replace("//", "").split(":")
    if len(parts) != 3 or not parts[2].isdigit() or int(parts[2]) > 65535:
        raise BadLink(f"a link is udpin, udpout, tcp or tcpin, then :HOST:PORT, not {url!r}")
    kind, host, port = parts[0], parts[1], int(parts[2])
    if kind in ("udpin", "udpout"):
        return Udp(host, port, listen=kind == "udpin")
    if kind == "tcp":
        return Tcp(socket.create_connection((host, port), timeout=5.0))
    if kind == "tcpin":
        return TcpServer(host, port)
    raise BadLink(f"a link is udpin, udpout, tcp or tcpin, not {kind!r}")

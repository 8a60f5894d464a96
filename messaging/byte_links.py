"""Links that carry the bytes of MAVLink, by URL.

udpin:HOST:PORT    listen; send to all peers that sent something in the last `FORGET` seconds
udpout:HOST:PORT   send to this address
tcp:HOST:PORT      connect
tcpin:HOST:PORT    listen; any number of connections

A link may lose bytes. `send` never waits, and a peer that is gone is no error. `receive` returns the bytes that arrived
since the last call.
"""

from __future__ import annotations

import contextlib
import socket
import time

from brakeline.errors import BadLink

FORGET = 10.0  # time after which a silent UDP peer gets nothing more [s]
LARGEST = 65536  # largest number of bytes in one read


class Udp:
    """A UDP socket that sends to a fixed peer, or to all that sent something in the last `FORGET` seconds."""

    def __init__(self, host: str, port: int, listen: bool) -> None:
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.setblocking(False)
        self._fixed = None if listen else (socket.gethostbyname(host), port)
        self._peers: dict[tuple[str, int], float] = {}
        self._socket.bind((host, port) if listen else ("0.0.0.0" if host != "127.0.0.1" else host, 0))

    @property
    def port(self) -> int:
        """The link's own port."""
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
            except OSError:  # the peer's port was closed at an earlier send
                continue
            self._peers[peer] = time.monotonic()
            parts.append(data)

    def close(self) -> None:
        self._socket.close()


class Tcp:
    """A TCP connection; after its end, `send` does nothing."""

    def __init__(self, connection: socket.socket) -> None:
        self._socket = connection
        self._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self._socket.setblocking(False)
        self.open = True

    def send(self, data: bytes) -> None:
        try:
            if self.open and self._socket.send(data) < len(data):
                self.open = False  # the peer does not read; a part of a frame would be useless
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
    """A TCP server that sends to all its connections."""

    def __init__(self, host: str, port: int) -> None:
        self._socket = socket.create_server((host, port))
        self._socket.setblocking(False)
        self._clients: list[Tcp] = []

    @property
    def port(self) -> int:
        """The link's own port."""
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


Link = Udp | Tcp | TcpServer


def open_link(url: str) -> Link:
    """Open the link at a URL.

    Raises:
        BadLink: the URL is not one of the four kinds.
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

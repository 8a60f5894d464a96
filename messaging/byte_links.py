"""Links that carry the bytes of MAVLink, by URL.

udpin:HOST:PORT    listen; send to all peers that sent something in the last `FORGET` seconds
udpout:HOST:PORT   send to this address
tcp:HOST:PORT      connect
tcpin:HOST:PORT    listen; any number of connections

A link may lose bytes. `send` never waits, and a peer that is gone is no error. With a peer's name (HOST:PORT), `send`
sends to that peer only; `udpout` and `tcp` have only one. `receive` returns the bytes that arrived since the last call,
and `receive_by_peer` returns them in pieces, each with the name of its sender.
"""

from __future__ import annotations

import contextlib
import socket
import time

from brakeline.errors import BadLink

FORGET = 10.0  # time after which a silent UDP peer gets nothing more [s]
LARGEST = 65536  # largest number of bytes in one read

Pieces = list[tuple[str, bytes]]


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

    def send(self, data: bytes, peer: str = "") -> None:
        now = time.monotonic()
        recent = [address for address, last_heard in self._peers.items() if now - last_heard < FORGET]
        for address in [self._fixed] if self._fixed else recent:
            if self._fixed or peer in ("", _name(address)):
                with contextlib.suppress(OSError):
                    self._socket.sendto(data, address)

    def receive(self) -> bytes:
        return _joined(self.receive_by_peer())

    def receive_by_peer(self) -> Pieces:
        pieces: Pieces = []
        while True:
            try:
                data, address = self._socket.recvfrom(LARGEST)
            except BlockingIOError:
                return pieces
            except OSError:  # the peer's port was closed at an earlier send
                continue
            self._peers[address] = time.monotonic()
            pieces.append((_name(address), data))

    def close(self) -> None:
        self._socket.close()


class Tcp:
    """A TCP connection; after its end, `send` does nothing."""

    def __init__(self, connection: socket.socket) -> None:
        self._socket = connection
        self._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self._socket.setblocking(False)
        self.open = True
        try:
            self.peer = _name(connection.getpeername())
        except OSError:  # it has hung up already
            self.peer = "a peer that is gone"

    def send(self, data: bytes, peer: str = "") -> None:
        try:
            if self.open and self._socket.send(data) < len(data):
                self.open = False  # the peer does not read; a part of a frame would be useless
        except OSError:
            self.open = False

    def receive_by_peer(self) -> Pieces:
        data = self.receive()
        return [(self.peer, data)] if data else []

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

    def send(self, data: bytes, peer: str = "") -> None:
        for client in self._clients:
            if peer in ("", client.peer):
                client.send(data)

    def receive(self) -> bytes:
        return _joined(self.receive_by_peer())

    def receive_by_peer(self) -> Pieces:
        with contextlib.suppress(BlockingIOError):
            self._clients.append(Tcp(self._socket.accept()[0]))
        pieces = [piece for client in self._clients for piece in client.receive_by_peer()]
        for client in [client for client in self._clients if not client.open]:
            client.close()
            self._clients.remove(client)
        return pieces

    def close(self) -> None:
        for client in self._clients:
            client.close()
        self._socket.close()


Link = Udp | Tcp | TcpServer


def _name(address: tuple[str, int]) -> str:
    return f"{address[0]}:{address[1]}"


def _joined(pieces: Pieces) -> bytes:
    return b"".join(data for _, data in pieces)


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

"""A proxy before the Foxglove WebSocket server, which accepts every client: the proxy rejects foreign web pages.

The server itself listens on a random loopback address out of 16 million, so that a page cannot guess how to bypass the
proxy.
"""

from __future__ import annotations

import contextlib
import secrets
import socket
import threading
import time
from collections.abc import Collection
from email.parser import BytesHeaderParser

from brakeline.messaging.allowed_hosts import rejection_reason
from brakeline.messaging.http_server import ConnectionSlots

ORIGINS = ("https://app.foxglove.dev",)  # Foxglove in a browser
MOST_HANDSHAKE = 2**14  # bytes
TIMEOUT = 5.0  # s for the handshake
BUFFER = 2**16  # bytes


def hidden_host() -> str:
    """Return a random loopback address."""
    return f"127.{secrets.randbelow(254) + 1}.{secrets.randbelow(256)}.{secrets.randbelow(254) + 1}"


class WebSocketGate:
    """Forwards clients from `host`:`port` to the server `behind` until `close`; port 0 selects a free port.

    Raises:
        OSError: the port is in use.
    """

    def __init__(self, host: str, port: int, behind: tuple[str, int], origins: Collection[str]) -> None:
        self._host, self._behind, self._origins = host, behind, origins
        self._socket = socket.create_server((host, port))
        self.port = int(self._socket.getsockname()[1])
        self._slots = ConnectionSlots()
        self._thread = threading.Thread(target=self._run, name="gate", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Accept no more clients. Connected clients are disconnected when the server ends."""
        with contextlib.suppress(OSError):
            self._socket.shutdown(socket.SHUT_RDWR)
        self._thread.join(TIMEOUT)
        self._socket.close()

    def _run(self) -> None:
        while True:
            try:
                client, _ = self._socket.accept()
            except OSError:  # closed
                return
            if self._slots.enter(client):
                threading.Thread(target=self._serve, args=(client,), name="client", daemon=True).start()
            else:
                client.close()

    def _serve(self, client: socket.socket) -> None:
        """Check the handshake of a client; then forward bytes in both directions, or reject the client."""
        try:
            with client, contextlib.suppress(OSError):
                head = _handshake(client)
                self._slots.serve(client)
                request, _, lines = head.partition(b"\r\n")
                headers = BytesHeaderParser().parsebytes(lines)
                why = rejection_reason(headers, (self._host,), self.port, self._origins)
                if why or not request.startswith(b"GET "):
                    text = f"{why or 'this server accepts only WebSocket connections'}\n".encode(errors="replace")
                    client.sendall(b"HTTP/1.1 403 Forbidden\r\nConnection: close\r\nContent-Type: text/plain\r\n")
                    client.sendall(b"Content-Length: %d\r\n\r\n%b" % (len(text), text))
                    return
                with socket.create_connection(self._behind, TIMEOUT) as inside:
                    inside.sendall(head)
                    _forward(client, inside)
        finally:
            self._slots.leave(client)


def _handshake(client: socket.socket) -> bytes:
    """Receive the handshake up to the empty line. Raises OSError: it is too long, or it does not arrive in time."""
    until, head = time.monotonic() + TIMEOUT, b""
    while b"\r\n\r\n" not in head:
        client.settimeout(max(until - time.monotonic(), 1e-3))
        piece = client.recv(BUFFER)
        head += piece
        if not piece or len(head) > MOST_HANDSHAKE:
            raise ConnectionError("the client sent no handshake")
    return head


def _forward(client: socket.socket, inside: socket.socket) -> None:
    """Forward bytes in both directions until one side closes."""
    for end in (client, inside):
        end.settimeout(None)
    inwards = threading.Thread(target=_pump, args=(client, inside), name="client in", daemon=True)
    inwards.start()
    _pump(inside, client)
    inwards.join()


def _pump(source: socket.socket, sink: socket.socket) -> None:
    with contextlib.suppress(OSError):
        while piece := source.recv(BUFFER):
            sink.sendall(piece)
    for end in (source, sink):  # ends the other direction, too
        with contextlib.suppress(OSError):
            end.shutdown(socket.SHUT_RDWR)

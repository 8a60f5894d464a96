"""A door before a websocket server that lets everybody in: visitors that may not look are turned away at the handshake.

The server behind listens at an address of this machine's own that is drawn at random, out of 16 million with thousands
of ports each: a page that does not come through the gate does not find it.
"""

from __future__ import annotations

import contextlib
import secrets
import socket
import threading
from collections.abc import Collection
from email.parser import BytesHeaderParser

from brakeline.logs.watch.allowed_hosts import rejection_reason

HEAD = 2**14  # bytes of a handshake, at most
PATIENCE = 5.0  # s for it
PIECE = 2**16
MOST = 64  # visitors at a time


def hidden_host() -> str:
    """An address of this machine alone that nobody can guess."""
    return f"127.{secrets.randbelow(254) + 1}.{secrets.randbelow(256)}.{secrets.randbelow(254) + 1}"


class WebSocketGate:
    """Listens at `host`:`port` (0: a free one), until `close`, for the server behind.

    Raises:
        OSError: the port is taken.
    """

    def __init__(self, host: str, port: int, behind: tuple[str, int], origins: Collection[str]) -> None:
        self._host, self._behind, self._origins = host, behind, origins
        self._socket = socket.create_server((host, port))
        self.port = int(self._socket.getsockname()[1])
        self._places = threading.Semaphore(MOST)
        self._thread = threading.Thread(target=self._run, name="gate", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Let nobody in any more. Those inside leave when the server behind ends."""
        with contextlib.suppress(OSError):
            self._socket.shutdown(socket.SHUT_RDWR)
        self._thread.join(PATIENCE)
        self._socket.close()

    def _run(self) -> None:
        while True:
            try:
                visitor, _ = self._socket.accept()
            except OSError:  # closed
                return
            if self._places.acquire(blocking=False):
                threading.Thread(target=self._visit, args=(visitor,), name="visitor", daemon=True).start()
            else:
                visitor.close()

    def _visit(self, visitor: socket.socket) -> None:
        """Hear the handshake; then carry bytes both ways, or say why not."""
        try:
            with visitor, contextlib.suppress(OSError):
                head = _handshake(visitor)
                said, _, headers = head.partition(b"\r\n")
                why = rejection_reason(BytesHeaderParser().parsebytes(headers), self._host, self.port, self._origins)
                if why or not said.startswith(b"GET "):
                    text = f"{why or 'only a websocket is here'}\n".encode(errors="replace")
                    visitor.sendall(b"HTTP/1.1 403 Forbidden\r\nConnection: close\r\nContent-Type: text/plain\r\n")
                    visitor.sendall(b"Content-Length: %d\r\n\r\n%b" % (len(text), text))
                    return
                with socket.create_connection(self._behind, PATIENCE) as inside:
                    inside.sendall(head)
                    _carry(visitor, inside)
        finally:
            self._places.release()


def _handshake(visitor: socket.socket) -> bytes:
    """The bytes up to the empty line, and what came with them. Raises OSError: they do not come, or are too many."""
    visitor.settimeout(PATIENCE)
    head = b""
    while b"\r\n\r\n" not in head:
        piece = visitor.recv(PIECE)
        head += piece
        if not piece or len(head) > HEAD:
            raise ConnectionError("no handshake")
    return head


def _carry(visitor: socket.socket, inside: socket.socket) -> None:
    """Both ways, until one of them ends."""
    for end in (visitor, inside):
        end.settimeout(None)
    inwards = threading.Thread(target=_pump, args=(visitor, inside), name="visitor in", daemon=True)
    inwards.start()
    _pump(inside, visitor)
    inwards.join()


def _pump(source: socket.socket, sink: socket.socket) -> None:
    with contextlib.suppress(OSError):
        while piece := source.recv(PIECE):
            sink.sendall(piece)
    for end in (source, sink):  # so that the other way ends too
        with contextlib.suppress(OSError):
            end.shutdown(socket.SHUT_RDWR)

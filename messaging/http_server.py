"""Serve HTTP to programs and pages of this machine, to a bounded number of clients, each for a bounded time.

A client that sends its request slowly, or no request, keeps its connection for `REQUEST_TIME` at most. It loses the
connection earlier if another client needs the place. The server refuses a request that names a foreign host, or comes
from a foreign page (`allowed_hosts`).
"""

from __future__ import annotations

import contextlib
import io
import socket
import sys
import threading
import time
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any

from brakeline.messaging.allowed_hosts import rejection_reason

LARGEST_PORT = 65535
MOST_CLIENTS = 64  # at the same time
REQUEST_TIME = 5.0  # from the connection, or the reply before, to the last header of a request [s]
REPLY_TIME = 10.0  # for a client that does not read a reply [s]


class ConnectionSlots:
    """The places of a server's connections. Thread-safe.

    If all are taken, a new connection takes the place of the one that has waited longest for its client's request.
    """

    def __init__(self, most: int = MOST_CLIENTS) -> None:
        self.most = most
        self._waiting: dict[socket.socket, None] = {}  # for a request, the longest first
        self._served: set[socket.socket] = set()
        self._lock = threading.Lock()

    def enter(self, connection: socket.socket) -> bool:
        """Give a place to a new connection. Return False if all other clients are being served."""
        with self._lock:
            if len(self._waiting) + len(self._served) >= self.most:
                if not self._waiting:
                    return False
                longest = next(iter(self._waiting))
                del self._waiting[longest]
                with contextlib.suppress(OSError):
                    longest.shutdown(socket.SHUT_RDWR)  # wakes up its thread
            self._waiting[connection] = None
            return True

    def await_request(self, connection: socket.socket) -> None:
        """Note that a connection waits for its next request."""
        with self._lock:
            if connection in self._served:
                self._served.remove(connection)
                self._waiting[connection] = None

    def serve(self, connection: socket.socket) -> None:
        """Note that the request of a connection is complete."""
        with self._lock:
            if connection in self._waiting:
                del self._waiting[connection]
                self._served.add(connection)

    def leave(self, connection: socket.socket) -> None:
        with self._lock:
            self._waiting.pop(connection, None)
            self._served.discard(connection)


class TimedReader(io.RawIOBase):
    """Reads from a connection until a deadline, however often the client sends a byte."""

    def __init__(self, connection: socket.socket) -> None:
        self._connection = connection
        self.restart()

    def restart(self) -> None:
        """Allow `REQUEST_TIME` from now on."""
        self._until = time.monotonic() + REQUEST_TIME

    def readable(self) -> bool:
        """Return True."""
        return True

    def readinto(self, buffer: Any) -> int:
        """Receive some bytes. Raises TimeoutError."""
        left = self._until - time.monotonic()
        if left <= 0.0:
            raise TimeoutError("the request did not arrive in time")
        self._connection.settimeout(left)
        return self._connection.recv_into(buffer)


class BoundedServer(ThreadingHTTPServer):
    """An HTTP server with a thread for each of at most `MOST_CLIENTS` clients."""

    daemon_threads = True
    request_queue_size = MOST_CLIENTS

    def __init__(self, address: tuple[str, int], handler: Any, own_port: bool = True) -> None:
        """Listen.

        Args:
            handler: makes a `BoundedHandler` for each client.
            own_port: whether a request must name the port of this server; a container may map it to another one.

        Raises:
            OSError: the address is in use or not of this machine, or the port is out of range.
        """
        if not 0 <= address[1] <= LARGEST_PORT:  # the socket would raise an OverflowError
            raise OSError(f"{address[1]} is no port: ports are 0 to {LARGEST_PORT}")
        self.slots = ConnectionSlots()
        try:
            super().__init__(address, handler)
        except OSError as error:
            why = f"{error.strerror}: cannot listen at {address[0]}:{address[1]}, give another port"
            raise OSError(error.errno, why) from error
        self.hosts = (address[0], socket.gethostname())
        self.checked_port = int(self.server_address[1]) if own_port else None

    def process_request(self, request: Any, client_address: Any) -> None:
        """Serve a client in a thread, if there is a place."""
        if self.slots.enter(request):
            super().process_request(request, client_address)
        else:
            self.shutdown_request(request)

    def shutdown_request(self, request: Any) -> None:
        """Close a connection."""
        self.slots.leave(request)
        super().shutdown_request(request)

    def handle_error(self, request: Any, client_address: Any) -> None:
        """Print a traceback, unless the client has gone."""
        if not isinstance(sys.exc_info()[1], OSError):
            super().handle_error(request, client_address)


class BoundedHandler(BaseHTTPRequestHandler):
    """Handles the requests of one client of a `BoundedServer`."""

    server: BoundedServer

    def setup(self) -> None:
        """Read with a deadline."""
        super().setup()
        self._reader = TimedReader(self.connection)
        self.rfile = io.BufferedReader(self._reader)

    def handle_one_request(self) -> None:
        """Wait for a request, and serve it."""
        self._reader.restart()
        self.server.slots.await_request(self.connection)
        super().handle_one_request()

    def parse_request(self) -> bool:
        """Read the headers. Return False for a request that is not served."""
        if not super().parse_request():
            return False
        self.server.slots.serve(self.connection)
        self.connection.settimeout(REPLY_TIME)
        reason = rejection_reason(self.headers, self.server.hosts, self.server.checked_port)
        if reason:
            self.reply_text(403, f"{reason}\n")
        return not reason

    def reply_text(self, status: int, text: str) -> None:
        self.reply(status, {"Content-Type": "text/plain; charset=utf-8"}, text.encode(errors="replace"))

    def reply(self, status: int, headers: dict[str, str], body: bytes) -> None:
        self.begin_reply(status, headers | {"Content-Length": str(len(body))})
        self.wfile.write(body)

    def begin_reply(self, status: int, headers: dict[str, str]) -> None:
        """Send the status and the headers."""
        self.send_response(status)
        for name, value in headers.items():
            self.send_header(name, value)
        self.end_headers()

    def log_message(self, format: str, *args: Any) -> None:
        """Log no requests."""

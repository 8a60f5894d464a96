"""Serves the live page: a few static files, and the board's view as server-sent events.

It answers nobody but this machine unless told to, no page but its own in any case, and the page asks nobody else: its
policy forbids it.
"""

from __future__ import annotations

import json
import math
import threading
import time
from collections.abc import Callable
from functools import partial
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from importlib.resources import files
from types import TracebackType
from typing import Any, Self

from brakeline.logs.watch.allowed_hosts import rejection_reason

RATE = 10.0  # Hz of events
PATIENCE = 10.0  # s for a request, and for a reader that does not read
FILES = {
    "/": ("page.html", "text/html; charset=utf-8"),
    "/page.js": ("page.js", "text/javascript; charset=utf-8"),
    "/page.css": ("page.css", "text/css; charset=utf-8"),
}
HEADERS = {
    "Content-Security-Policy": "default-src 'none'; script-src 'self'; style-src 'self'; connect-src 'self'; "
    "img-src data:; base-uri 'none'; form-action 'none'; frame-ancestors 'none'",
    "Cache-Control": "no-store",
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
}

View = Callable[[], dict[str, Any]]


class LivePageServer:
    """The page at `url`, from `with` to the end of the block.

    Raises:
        OSError: the port is taken.
    """

    def __init__(self, view: View, host: str = "127.0.0.1", port: int = 0) -> None:
        """`port` 0: a free one."""
        self._ended = threading.Event()
        self._http = ThreadingHTTPServer((host, port), partial(_Handler, view, self._ended, host))
        self._http.daemon_threads = True
        shown = f"[{host}]" if ":" in host else host
        self.url = f"http://{shown}:{self._http.server_address[1]}/"

    def __enter__(self) -> Self:
        threading.Thread(target=self._http.serve_forever, name="page", daemon=True).start()
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, _: TracebackType | None) -> None:
        self._ended.set()
        self._http.shutdown()
        self._http.server_close()


class _Handler(BaseHTTPRequestHandler):
    protocol_version = "HTTP/1.1"

    timeout = PATIENCE

    def __init__(self, view: View, ended: threading.Event, host: str, *rest: Any) -> None:
        self._view, self._ended, self._host = view, ended, host
        super().__init__(*rest)

    def do_GET(self) -> None:
        path = self.path.split("?", 1)[0]
        try:
            if why := rejection_reason(self.headers, self._host, self.connection.getsockname()[1]):
                self._send(403, "text/plain; charset=utf-8", f"{why}\n".encode(errors="replace"))
            elif path == "/events":
                self._events()
            elif path == "/view.json":
                self._send(200, "application/json", encode(self._view()).encode())
            elif path in FILES:
                name, kind = FILES[path]
                self._send(200, kind, (files("brakeline.logs.watch") / name).read_bytes())
            else:
                self._send(404, "text/plain; charset=utf-8", b"there is only /\n")
        except (ConnectionError, TimeoutError):  # whoever looked has gone
            self.close_connection = True

    def _send(self, status: int, kind: str, body: bytes) -> None:
        self._head(status, kind)
        self.send_header("Content-Length", str(len(body)))
        self.end_headers()
        self.wfile.write(body)

    def _events(self) -> None:
        """The view, again and again, until the reader or the server goes."""
        self.close_connection = True
        self._head(200, "text/event-stream")
        self.send_header("Connection", "close")
        self.end_headers()
        while not self._ended.is_set():
            self.wfile.write(b"data: " + encode(self._view()).encode() + b"\n\n")
            self.wfile.flush()
            time.sleep(1.0 / RATE)

    def _head(self, status: int, kind: str) -> None:
        self.send_response(status)
        self.send_header("Content-Type", kind)
        for name, value in HEADERS.items():
            self.send_header(name, value)

    def log_message(self, format: str, *args: Any) -> None:
        """Nobody needs to know who looks."""


def encode(view: dict[str, Any]) -> str:
    """One line of JSON; what is not finite becomes null."""
    return json.dumps(_finite(view), separators=(",", ":"))


def _finite(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _finite(inner) for key, inner in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(inner) for inner in value]
    if isinstance(value, float):
        return round(value, 4) if math.isfinite(value) else None
    return value

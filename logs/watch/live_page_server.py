"""Serve the live page: static files, and the dashboard's view as server-sent events.

By default only this machine can connect. Foreign web pages are rejected, and the page's content security policy forbids
requests to other servers.
"""

from __future__ import annotations

import json
import threading
import time
from collections.abc import Callable
from functools import partial
from importlib.resources import files
from typing import Any, Self

from brakeline.logs.json_values import finite
from brakeline.logs.viewer import SCRIPTS, STYLES
from brakeline.messaging.http_server import MOST_CLIENTS, BoundedHandler, BoundedServer

RATE = 10.0  # Hz of events
MOST_STREAMS = MOST_CLIENTS // 2  # pages at the same time; the other places are for short requests
HTML, CSS, SCRIPT = (f"text/{kind}; charset=utf-8" for kind in ("html", "css", "javascript"))
FILES = {  # path: file in logs/, media type
    "/": ("watch/page.html", HTML),
    "/page.css": ("watch/page.css", CSS),
    "/page.js": ("watch/page.js", SCRIPT),
    **{f"/{name}": (f"viewer/{name}", CSS) for name in STYLES},
    **{f"/{name}": (f"viewer/{name}", SCRIPT) for name in SCRIPTS},
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
    """An HTTP server of the live page at `url`; a context manager.

    Raises:
        OSError: the port is in use.
    """

    def __init__(self, view: View, host: str = "127.0.0.1", port: int = 0) -> None:
        """Create the server; `port` 0 selects a free port. `view` returns what the page shows."""
        self._ended = threading.Event()
        streams = threading.Semaphore(MOST_STREAMS)
        self._http = BoundedServer((host, port), partial(_Handler, view, self._ended, streams))
        shown = f"[{host}]" if ":" in host else host
        self.url = f"http://{shown}:{self._http.server_address[1]}/"

    def __enter__(self) -> Self:
        threading.Thread(target=self._http.serve_forever, name="page", daemon=True).start()
        return self

    def __exit__(self, *_: object) -> None:
        self._ended.set()
        self._http.shutdown()
        self._http.server_close()


class _Handler(BoundedHandler):
    protocol_version = "HTTP/1.1"

    def __init__(self, view: View, ended: threading.Event, streams: threading.Semaphore, *rest: Any) -> None:
        self._view, self._ended, self._streams = view, ended, streams
        super().__init__(*rest)

    def do_GET(self) -> None:
        path = self.path.split("?", 1)[0]
        try:
            if path == "/events":
                self._events()
            elif path == "/view.json":
                self._send(200, "application/json", encode(self._view()).encode())
            elif path in FILES:
                name, kind = FILES[path]
                self._send(200, kind, (files("brakeline.logs") / name).read_bytes())
            else:
                self.reply_text(404, "not found; the page is at /\n")
        except (ConnectionError, TimeoutError):  # the client has disconnected
            self.close_connection = True

    def _send(self, status: int, kind: str, body: bytes) -> None:
        self._head(status, kind)
        self.send_header("Content-Length", str(len(body)))
        self.end_headers()
        self.wfile.write(body)

    def _events(self) -> None:
        """Send the view repeatedly until the client disconnects or the server stops."""
        self.close_connection = True
        if not self._streams.acquire(blocking=False):
            self.reply_text(503, f"{MOST_STREAMS} pages are open already\n")
            return
        try:
            self._head(200, "text/event-stream")
            self.send_header("Connection", "close")
            self.end_headers()
            while not self._ended.is_set():
                self.wfile.write(b"data: " + encode(self._view()).encode() + b"\n\n")
                self.wfile.flush()
                time.sleep(1.0 / RATE)
        finally:
            self._streams.release()

    def _head(self, status: int, kind: str) -> None:
        self.send_response(status)
        self.send_header("Content-Type", kind)
        for name, value in HEADERS.items():
            self.send_header(name, value)


def encode(view: dict[str, Any]) -> str:
    """Encode the view as one line of JSON; a number that is not finite becomes null."""
    return json.dumps(finite(view, digits=4), separators=(",", ":"))

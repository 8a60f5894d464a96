"""Serve the live page: static files, the dashboard's view as server-sent events, and the report of an ended run.

By default only this machine can connect. Foreign web pages are rejected, and the page's content security policy forbids
requests to other servers.
"""

from __future__ import annotations

import json
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from importlib.resources import files
from pathlib import Path
from typing import Any, Self

from brakeline.errors import LogError
from brakeline.logs.json_values import finite
from brakeline.logs.viewer import SCRIPTS, STYLES
from brakeline.messaging.http_server import MOST_CLIENTS, BoundedHandler, BoundedServer

RATE = 10.0  # Hz of events
MOST_STREAMS = MOST_CLIENTS // 2  # pages at the same time; the other places are for short requests
REPORT = "/report.html"
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

# The report's own policy allows its scripts and styles, by their hashes. Both policies hold.
REPORT_HEADERS = HEADERS | {"Content-Security-Policy": "base-uri 'none'; form-action 'none'; frame-ancestors 'none'"}

View = Callable[[], dict[str, Any]]


class RunReport:
    """The report of the run in a folder. Rendering takes seconds, so it happens once."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self._lock = threading.Lock()
        self._page = b""

    def page(self) -> bytes:
        """Return the page.

        Raises:
            LogError, OSError: the folder has no log that can be read.
        """
        from brakeline.logs.log_analysis import AnalysisOptions, analyse_runs  # imported only when they are needed
        from brakeline.logs.report_page import render

        with self._lock:
            if not self._page:
                analysis = analyse_runs(self.folder, AnalysisOptions(pictures=True))
                self._page = render(analysis.figures(), analysis.by_label()).encode()
            return self._page


class OpenPages:
    """Counts the pages that are open, and limits the event streams of all of them."""

    def __init__(self) -> None:
        self._free = threading.Semaphore(MOST_STREAMS)
        self._lock = threading.Lock()
        self.count = 0

    @contextmanager
    def one(self, limited: bool) -> Iterator[bool]:
        """Count one page until the end of the block. Yields False if it is `limited` and there are too many."""
        if limited and not self._free.acquire(blocking=False):
            yield False
            return
        try:
            self._add(1)
            yield True
        finally:
            self._add(-1)
            if limited:
                self._free.release()

    def _add(self, change: int) -> None:
        with self._lock:
            self.count += change


class LivePageServer:
    """An HTTP server of the live page at `url`; a context manager.

    Raises:
        OSError: the port is in use.
    """

    def __init__(self, view: View, host: str = "127.0.0.1", port: int = 0, report: RunReport | None = None) -> None:
        """Create the server.

        Args:
            view: returns what the page shows.
            host: address to listen on.
            port: 0 selects a free port.
            report: of the run, which is served when the run has ended; None: this machine does not have its log.
        """
        self._ended = threading.Event()
        self._http = BoundedServer((host, port), partial(_Handler, view, self._ended, OpenPages(), report))
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

    def __init__(
        self, view: View, ended: threading.Event, pages: OpenPages, report: RunReport | None, *rest: Any
    ) -> None:
        self._board, self._ended, self._pages, self._report = view, ended, pages, report
        super().__init__(*rest)

    def _view(self) -> dict[str, Any]:
        """Return the dashboard's view, with whether there is a report, and how many pages are open."""
        return self._board() | {"report": self._report is not None, "pages": self._pages.count}

    def do_GET(self) -> None:
        path = self.path.split("?", 1)[0]
        try:
            if path == "/events":
                self._events()
            elif path == "/view.json":
                self._send("application/json", encode(self._view()).encode())
            elif path == REPORT:
                self._send_report()
            elif path in FILES:
                name, kind = FILES[path]
                self._send(kind, (files("brakeline.logs") / name).read_bytes())
            else:
                self.reply_text(404, "not found; the page is at /\n")
        except (ConnectionError, TimeoutError):  # the client has disconnected
            self.close_connection = True

    def _send_report(self) -> None:
        """Send the report of a run that has ended. This takes seconds the first time."""
        if self._report is None:
            self.reply_text(404, "no report: start `brakeline watch` on the machine of the run, with --report FOLDER\n")
        elif "outcome" not in self._view().get("run", {}):
            self.reply_text(404, "the run goes on: its report is here when it has ended\n")
        else:
            with self._pages.one(limited=False):
                try:
                    page = self._report.page()
                except (LogError, OSError, ValueError) as error:
                    words = f"no report: {error}. Try `brakeline analyse {self._report.folder} --html report.html`\n"
                    self.reply_text(500, words)
                else:
                    self._send(HTML, page, REPORT_HEADERS)

    def _send(self, kind: str, body: bytes, headers: dict[str, str] = HEADERS) -> None:
        self.reply(200, {"Content-Type": kind} | headers, body)

    def _events(self) -> None:
        """Send the view repeatedly until the client disconnects or the server stops."""
        self.close_connection = True
        with self._pages.one(limited=True) as allowed:
            if not allowed:
                self.reply_text(503, f"{MOST_STREAMS} pages are open already\n")
                return
            self.begin_reply(200, {"Content-Type": "text/event-stream"} | HEADERS | {"Connection": "close"})
            while not self._ended.is_set():
                self.wfile.write(b"data: " + encode(self._view()).encode() + b"\n\n")
                self.wfile.flush()
                time.sleep(1.0 / RATE)


def encode(view: dict[str, Any]) -> str:
    """Encode the view as one line of JSON; a number that is not finite becomes null."""
    return json.dumps(finite(view, digits=4), separators=(",", ":"))

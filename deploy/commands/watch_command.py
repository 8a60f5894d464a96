"""`brakeline watch`."""

from __future__ import annotations

import json
import threading
import time
from collections import deque
from contextlib import ExitStack
from dataclasses import dataclass, field

from brakeline.deploy.commands.common_options import Endpoints, Flags, console
from brakeline.logs.watch.dashboard import Dashboard
from brakeline.logs.watch.foxglove_server import ORIGINS, FoxgloveServer
from brakeline.logs.watch.live_page_server import LivePageServer
from brakeline.messaging.bus import Bus, Sample
from brakeline.messaging.rejected_messages import RejectedMessages
from brakeline.messaging.stop_signals import stop_on_signals
from brakeline.messaging.topics import RECORDED

TURN = 0.05  # s between two looks into the inbox
INBOX = 20_000  # samples: beyond them the oldest are not shown, and nobody has to wait


@dataclass(frozen=True)
class Watch:
    endpoints: Flags[Endpoints] = field(default_factory=Endpoints)
    host: str = "127.0.0.1"
    """Who may look: this machine alone, unless an address of it that others reach is given."""
    port: int = 8787
    """Of the web page; 0: any."""
    foxglove_port: int = 8765
    """Of the server that Foxglove connects to; 0: any; -1: none."""
    origins: tuple[str, ...] = ORIGINS
    """Of the web pages that may connect there besides programs, e.g. https://app.foxglove.dev."""
    json: bool = False
    """Print where to look as one JSON object on stdout."""

    def run(self) -> int:
        inbox: deque[Sample] = deque(maxlen=INBOX)
        board, live = Dashboard(), None
        with ExitStack() as stack:
            bus = stack.enter_context(Bus(self.endpoints.bus(), f"viewer.watch-{time.time_ns() % 10**6}"))
            server = stack.enter_context(LivePageServer(board.view, self.host, self.port))
            if self.foxglove_port >= 0:
                live = stack.enter_context(FoxgloveServer(self.host, self.foxglove_port, origins=self.origins))
            stop = stack.enter_context(stop_on_signals(threading.Event()))
            for topic in RECORDED:
                bus.subscribe(topic, inbox.append)
            self._say(server.url, live.url if live is not None else None)
            while not stop.wait(TURN):
                _show(inbox, board, live, bus.rejected)
        return 0

    def _say(self, page: str, foxglove: str | None) -> None:
        if self.json:
            print(json.dumps({"page": page, "foxglove": foxglove}), flush=True)
            return
        console.print(f"page:     {page}", markup=False)
        if foxglove is not None:
            console.print(f"Foxglove: {foxglove} (layout: logs/brakeline.foxglove-layout.json)", markup=False)
        console.print("[dim]^C ends the watching; the run goes on[/]")


def _show(inbox: deque[Sample], board: Dashboard, live: FoxgloveServer | None, rejected: RejectedMessages) -> None:
    """What has come since the last look."""
    for _ in range(len(inbox)):
        sample = inbox.popleft()
        with rejected.skip_on_error(sample.key):
            board.take(sample)
            if live is not None:
                live.take(sample)
    if live is not None:
        live.refresh()

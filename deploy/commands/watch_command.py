"""Implement `brakeline watch`: show a running system on a web page and in Foxglove."""

from __future__ import annotations

import json
import threading
import time
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

from brakeline.deploy.commands.command_output import console
from brakeline.deploy.commands.common_options import LATEST, BusOptions, Unprefixed
from brakeline.logs.watch.websocket_gate import ORIGINS
from brakeline.messaging.bus import Bus
from brakeline.messaging.bus.inbox import Inbox
from brakeline.messaging.rejected_messages import RejectedMessages
from brakeline.messaging.stop_signals import stop_on_signals
from brakeline.messaging.topics import RECORDED

if TYPE_CHECKING:
    from brakeline.logs.watch.dashboard import Dashboard
    from brakeline.logs.watch.foxglove_server import FoxgloveServer
    from brakeline.logs.watch.live_page_server import RunReport

REFRESH_PERIOD = 0.05  # s
MOST_SHOWING = 1.0  # s of one refresh; a signal ends the command after it


@dataclass(frozen=True)
class WatchCommand:
    """The options of `brakeline watch`."""

    endpoints: Unprefixed[BusOptions] = field(default_factory=BusOptions)
    host: str = "127.0.0.1"
    """Serve at this address. Only this machine can watch, unless you give an address that others reach."""
    port: int = 8787
    """Serve the web page at this port. 0 takes any free port."""
    foxglove_port: int = 8765
    """Let Foxglove connect at this port. 0 takes any free port; -1 starts no server."""
    origins: tuple[str, ...] = ORIGINS
    """Let these web pages connect to the Foxglove server, such as https://app.foxglove.dev. Programs other than
    browsers may always connect."""
    report: Path | None = None
    """Link to the report of the run in this folder when the run has ended. Defaults to the newest run on this machine
    if you give no endpoint."""
    json: bool = False
    """Print the addresses as one JSON object on stdout."""

    def run(self) -> int:
        """Serve the live views until SIGINT or SIGTERM. Returns the exit status."""
        from brakeline.logs.watch.dashboard import Dashboard
        from brakeline.logs.watch.foxglove_server import FoxgloveServer
        from brakeline.logs.watch.live_page_server import LivePageServer

        inbox, board, live = Inbox(), Dashboard(), None
        with ExitStack() as stack:
            bus = stack.enter_context(Bus(self.endpoints.bus(), f"viewer.watch-{time.time_ns() % 10**6}"))
            server = stack.enter_context(LivePageServer(board.view, self.host, self.port, self._report()))
            if self.foxglove_port >= 0:
                live = stack.enter_context(FoxgloveServer(self.host, self.foxglove_port, origins=self.origins))
            stop = stack.enter_context(stop_on_signals(threading.Event()))
            for topic in RECORDED:
                bus.subscribe(topic, inbox.put)
            self._print_addresses(server.url, live.url if live is not None else None)
            while not stop.wait(REFRESH_PERIOD):
                show_received(inbox, board, live, bus.rejected)
        return 0

    def _report(self) -> RunReport | None:
        """Return the report of the run that is watched, if this machine has its log."""
        from brakeline.logs.watch.live_page_server import RunReport

        if self.report is None and (self.endpoints.connect or self.endpoints.listen):
            return None
        return RunReport((self.report or LATEST).resolve())

    def _print_addresses(self, page: str, foxglove: str | None) -> None:
        if self.json:
            print(json.dumps({"page": page, "foxglove": foxglove}), flush=True)
            return
        console.print(f"page:     {page}", markup=False)
        if foxglove is not None:
            console.print(f"Foxglove: {foxglove} (layout: logs/brakeline.foxglove-layout.json)", markup=False)
        console.print("[dim]^C ends only this command; the run continues[/]")


def show_received(inbox: Inbox, board: Dashboard, live: FoxgloveServer | None, rejected: RejectedMessages) -> None:
    """Empty the inbox into the web page and the Foxglove server. Skip messages that can't be shown."""
    for sample in inbox.drain(MOST_SHOWING):
        with rejected.skip_on_error(sample.key):
            board.add(sample)
            if live is not None:
                live.publish(sample)
    if live is not None:
        live.refresh()

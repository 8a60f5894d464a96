"""What the processes have in common: a place on the bus, log lines, a sign of life each second, an orderly end.

with Process(settings, "safety") as process:
    process.bus.serve(DECIDE, answer)
    process.stop.wait()
"""

from __future__ import annotations

import logging
import os
import sys
import threading
import time
from collections.abc import Callable
from types import TracebackType
from typing import Self

from brakeline.messaging import brakeline_pb2 as pb
from brakeline.messaging.bus import Bus, BusError, BusSettings, Publisher
from brakeline.messaging.metrics_endpoint import MetricsServer, State
from brakeline.messaging.stop_signals import stop_on_signals
from brakeline.messaging.topics import HEALTH, LOG

log = logging.getLogger("brakeline.process")

SILENT = 10.0  # s without a beat after which a process does not live any more: its threads are stuck
LEVELS = {"CRITICAL": "ERROR"}  # names that LogLine does not know


class Process:
    """A process under the name `source`, from `with` to the end of the block.

    `stop` is set by SIGINT and SIGTERM (and by whoever wants the process to end), see
    `brakeline.messaging.stop_signals`. `figures`
    and `notes` go out with the next Health, and how many messages were passed over; `refresh`, if set, is called before
    each to bring them up to date. All that is logged goes to stderr (unless `stderr` is False) and to the LOG topic. An
    exception that leaves the block goes to the LOG topic with its traceback, is noted in the last Health, and goes on
    its way: stderr is for who catches it. The first Health follows `announce`, or a second (not if `reserved`). With
    `settings.metrics` all of it is to be had over HTTP too (messaging/metrics_endpoint.py).

    Raises:
        Unreachable, Insecure, BadKeys: on entering, when there is no bus at `settings`, or not such a one.
        ValueError, OSError: on entering, when nothing can be served at `settings.metrics`.
    """

    def __init__(self, settings: BusSettings, source: str, stderr: bool = True, reserved: bool = False) -> None:
        self.settings = settings
        self.source = source
        self.stop = threading.Event()
        self.figures: dict[str, float] = {}
        self.notes: dict[str, str] = {}
        self.refresh: Callable[[], None] | None = None
        self._stderr, self._reserved = stderr, reserved
        self._handlers: list[logging.Handler] = []
        self._signals = stop_on_signals(self.stop)
        self._ended = False
        self._due = threading.Event()
        self._announced = False
        self._beat_at = time.monotonic()
        self._exposition: MetricsServer | None = None

    def __enter__(self) -> Self:
        self.bus = Bus(self.settings, self.source)
        try:
            if self.settings.metrics:
                self._exposition = MetricsServer(self.settings.metrics, self._state)
        except (ValueError, OSError):
            self.bus.close()
            raise
        if self.settings.warning:
            self.notes["security"] = self.settings.warning
        self._health = self.bus.publisher(HEALTH)
        self._start_logging()
        self._signals.__enter__()
        if self.settings.warning:
            log.warning("%s", self.settings.warning)
        self._pulse = threading.Thread(target=self._beat, name="health", daemon=True)
        self._pulse.start()
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, _: TracebackType | None) -> None:
        if isinstance(error, Exception):
            for handler in self._handlers[1:]:
                logging.getLogger().removeHandler(handler)
            log.error("%s ends: %s", self.source, error, exc_info=error)
            self.notes["died of"] = f"{type(error).__name__}: {error}"
        self.stop.set()
        self._ended = True
        self._due.set()
        self._pulse.join(2.0)
        if self._exposition is not None:
            self._exposition.close()
        self._stop_logging()
        try:
            self._report(last=True)
        except Exception:
            log.exception("no goodbye")
        self.bus.close()
        self._signals.__exit__(None, None, None)

    def announce(self) -> None:
        """Send a Health now: the process is ready, or something changed that cannot wait."""
        self._announced = True
        self._due.set()

    def _beat(self) -> None:
        period = 1.0 / (HEALTH.rate or 1.0)
        waiting = None if self._reserved else period
        while True:
            self._due.wait(waiting)
            waiting = period
            self._due.clear()
            self._beat_at = time.monotonic()
            if self._ended:
                return
            try:
                self._report()
            except Exception:
                log.exception("no sign of life")

    def _state(self) -> State:
        connected = bool(self.settings.listen) or self.bus.connected
        return State(
            self.source,
            live=time.monotonic() - self._beat_at < SILENT,
            ready=self._announced and connected and not self.stop.is_set(),
            connected=connected,
            figures=dict(self.figures) | {"passed over": self.bus.rejected.count},
            published=self.bus.published(),
        )

    def _report(self, last: bool = False) -> None:
        if self.refresh is not None:
            self.refresh()
        published = self.bus.published()
        published[self._health.key] += 1  # this one
        self._health.put(
            pb.Health(
                process=self.source,
                pid=os.getpid(),
                published=published,
                figures=dict(self.figures) | {"passed over": self.bus.rejected.count},
                notes=dict(self.notes),
                last=last,
            )
        )

    def _start_logging(self) -> None:
        self._handlers = [BusHandler(self.bus.publisher(LOG), self.source)]  # the bus's comes first
        if self._stderr:
            stream = logging.StreamHandler(sys.stderr)
            stream.setFormatter(logging.Formatter(f"%(asctime)s {self.source} %(levelname)s %(message)s"))
            self._handlers.append(stream)
        root = logging.getLogger()
        self._level = root.level
        root.setLevel(logging.INFO)
        for handler in self._handlers:
            root.addHandler(handler)

    def _stop_logging(self) -> None:
        root = logging.getLogger()
        root.setLevel(self._level)
        for handler in self._handlers:
            root.removeHandler(handler)


class BusHandler(logging.Handler):
    """Publishes what is logged. What happens while it does so is not published again."""

    def __init__(self, publisher: Publisher, process: str) -> None:
        super().__init__()
        self._publisher, self._process = publisher, process
        self._busy = threading.local()

    def emit(self, record: logging.LogRecord) -> None:
        if getattr(self._busy, "now", False):
            return
        self._busy.now = True
        try:
            level = LEVELS.get(record.levelname, record.levelname)
            self._publisher.put(pb.LogLine(process=self._process, level=level, text=self.format(record)))
        except BusError:
            pass  # the bus is closing; stderr has the line
        finally:
            self._busy.now = False

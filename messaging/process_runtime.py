"""Run a process on the bus: connection, log lines, a Health message each second, and an orderly end.

with Process(settings, "safety") as process:
    process.bus.serve(DECIDE, answer)
    process.stop.wait()
"""

from __future__ import annotations

import contextlib
import logging
import os
import queue
import sys
import threading
import time
from collections.abc import Callable
from types import TracebackType
from typing import Self

from brakeline.errors import BusError
from brakeline.messaging import brakeline_pb2 as pb
from brakeline.messaging.bus import Bus, BusSettings, Publisher
from brakeline.messaging.metrics_endpoint import MetricsServer, ProcessStatus
from brakeline.messaging.stop_signals import stop_on_signals
from brakeline.messaging.topics import HEALTH, LOG

log = logging.getLogger("brakeline.process")

MAX_SILENCE = 10.0  # time without a Health after which the process counts as stuck [s]
MAX_WAITING_LINES = 1000  # log lines that wait for the bus; further ones are lost to it
CLOSE_TIMEOUT = 1.0  # for the log lines that wait when the process ends [s]
LEVELS = {"CRITICAL": "ERROR"}  # levels that LogLine does not have


class Process:
    """A process on the bus under the name `source`, from `with` to the end of the block.

    - SIGINT, SIGTERM and code that wants the process to end set `stop` (`brakeline.messaging.stop_signals`).
    - Each second the process publishes a Health with `figures` and `notes`; `refresh`, if set, updates them before. The
      first Health follows `announce`, or comes after a second (not if `reserved`).
    - Log lines go to stderr, unless `stderr` is False, and to the LOG topic.
    - An exception that leaves the block is logged with its traceback to the LOG topic, noted in the last Health, and
      raised again; the caller writes it to stderr.
    - With `settings.metrics`, the process serves its status over HTTP (messaging/metrics_endpoint.py).

    Raises:
        Unreachable, BadKeys: on entering, if the process cannot join the bus at `settings`.
        ValueError, OSError: on entering, if the process cannot serve its metrics at `settings.metrics`.
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
        self._published_at = time.monotonic()
        self._metrics: MetricsServer | None = None

    def __enter__(self) -> Self:
        self.bus = Bus(self.settings, self.source)
        self._bus_handler = BusHandler(self.bus.publisher(LOG), self.source)
        try:
            if self.settings.metrics:
                self._metrics = MetricsServer(self.settings.metrics, self._status)
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
        self._health_thread = threading.Thread(target=self._publish_health, name="health", daemon=True)
        self._health_thread.start()
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
        self._health_thread.join(2.0)
        if self._metrics is not None:
            self._metrics.close()
        self._stop_logging()
        try:
            self._put_health(last=True)
        except Exception:
            log.exception("the last Health was not published")
        self.bus.close()
        self._signals.__exit__(None, None, None)

    def announce(self) -> None:
        """Publish a Health now: the process is ready, or an important value changed."""
        self._announced = True
        self._due.set()

    def _publish_health(self) -> None:
        period = 1.0 / (HEALTH.rate or 1.0)
        waiting = None if self._reserved else period
        while True:
            self._due.wait(waiting)
            waiting = period
            self._due.clear()
            self._published_at = time.monotonic()
            if self._ended:
                return
            try:
                self._put_health()
            except Exception:
                log.exception("the Health was not published")

    def _status(self) -> ProcessStatus:
        connected = bool(self.settings.listen) or self.bus.connected
        return ProcessStatus(
            self.source,
            live=time.monotonic() - self._published_at < MAX_SILENCE,
            ready=self._announced and connected and not self.stop.is_set(),
            connected=connected,
            figures=self._all_figures(),
            published=self.bus.published(),
        )

    def _all_figures(self) -> dict[str, float]:
        lost = self._bus_handler.lost
        return self.figures | {"passed over": self.bus.rejected.count} | ({"log lines lost": lost} if lost else {})

    def _put_health(self, last: bool = False) -> None:
        if self.refresh is not None:
            self.refresh()
        published = self.bus.published()
        published[self._health.key] += 1  # this message
        self._health.put(
            pb.Health(
                process=self.source,
                pid=os.getpid(),
                published=published,
                figures=self._all_figures(),
                notes=dict(self.notes),
                last=last,
            )
        )

    def _start_logging(self) -> None:
        self._handlers = [self._bus_handler]  # `__exit__` relies on this order
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
            handler.close()


class BusHandler(logging.Handler):
    """A handler that publishes log records in a thread of its own, until `close`.

    A thread that logs never waits for the bus: it may be the thread that empties the queue into which the line goes.
    """

    def __init__(self, publisher: Publisher, process: str) -> None:
        super().__init__()
        self.lost = 0  # number of lines that found `MAX_WAITING_LINES` lines waiting
        self._publisher, self._process = publisher, process
        self._lines: queue.Queue[pb.LogLine | None] = queue.Queue(MAX_WAITING_LINES)
        self._thread = threading.Thread(target=self._publish, name="log", daemon=True)
        self._thread.start()

    def emit(self, record: logging.LogRecord) -> None:
        if threading.current_thread() is self._thread:
            return
        level = LEVELS.get(record.levelname, record.levelname)
        try:
            self._lines.put_nowait(pb.LogLine(process=self._process, level=level, text=self.format(record)))
        except queue.Full:
            self.lost += 1  # stderr has the line

    def close(self) -> None:
        """Publish the waiting lines, for at most `CLOSE_TIMEOUT`."""
        with contextlib.suppress(queue.Full):
            self._lines.put(None, timeout=CLOSE_TIMEOUT)
        self._thread.join(CLOSE_TIMEOUT)
        super().close()

    def _publish(self) -> None:
        while (line := self._lines.get()) is not None:
            with contextlib.suppress(BusError):  # the bus is closing; stderr has the line
                self._publisher.put(line)

"""Count and log messages that cannot be handled, so that one bad message never stops a process.

Each process has one `RejectedMessages`, that of its bus. Its count is in the process's Health.
"""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

log = logging.getLogger("brakeline.rejected")

LOG_PERIOD = 1.0  # least time between two log lines [s]: the bus may bring a line back to the handler that failed
MAX_LINE_LENGTH = 300


class RejectedMessages:
    """A thread-safe counter of rejected messages."""

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self.count = 0
        self._clock, self._logged_at, self._lock = clock, -1e9, threading.Lock()

    @contextmanager
    def skip_on_error(self, name: str) -> Iterator[None]:
        """Reject the message `name` if the block raises an exception."""
        try:
            yield
        except Exception as error:
            self.reject(name, error)

    def reject(self, name: str, error: Exception, level: int = logging.ERROR) -> None:
        """Count a message that cannot be handled, and log why, at most once in `LOG_PERIOD`.

        The log has a traceback if the level is ERROR and the error is unexpected: not a ValueError, which describes a
        mistake in the message.
        """
        with self._lock:
            self.count += 1
            due = self._clock() - self._logged_at >= LOG_PERIOD
            if due:
                self._logged_at = self._clock()
        if due:
            text = headline(f"{name}: {type(error).__name__}: {error}")
            expected = level < logging.ERROR or isinstance(error, ValueError)
            log.log(level, "passed over (%d so far): %s", self.count, text, exc_info=None if expected else error)


def headline(text: str, length: int = MAX_LINE_LENGTH) -> str:
    """Return the first line of an untrusted text, shortened, with control characters replaced."""
    line = text[: 4 * length].strip().split("\n", 1)[0]
    return "".join(c if c.isprintable() else "\N{REPLACEMENT CHARACTER}" for c in line)[:length]

"""One message is one message: what can't be handled is counted, named in the log once a second at the most, and passed
over. Every process has one `RejectedMessages`, its bus's; the count is in its Health."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

log = logging.getLogger("brakeline.tolerant")

SPACING = 1.0  # s between two lines: a line may come back over the bus to the handler that failed
LONGEST = 300  # characters of a line


class RejectedMessages:
    """Counts what was passed over, in any thread."""

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self.count = 0
        self._clock, self._said_at, self._lock = clock, -1e9, threading.Lock()

    @contextmanager
    def skip_on_error(self, what: str) -> Iterator[None]:
        """Pass over `what` if the block raises."""
        try:
            yield
        except Exception as error:
            self.reject(what, error)

    def reject(self, what: str, error: Exception, level: int = logging.ERROR) -> None:
        """`what` could not be handled, for this reason; below an error's level it is named without its place."""
        with self._lock:
            self.count += 1
            due = self._clock() - self._said_at >= SPACING
            if due:
                self._said_at = self._clock()
        if due:
            why = headline(f"{what}: {type(error).__name__}: {error}")
            # A ValueError says what is wrong with the message; any other error, where we did not expect it.
            expected = level < logging.ERROR or isinstance(error, ValueError)
            log.log(level, "passed over (%d so far): %s", self.count, why, exc_info=None if expected else error)


def headline(text: str, longest: int = LONGEST) -> str:
    """The first line of a text that somebody else wrote, fit for a terminal: no control characters, not too long."""
    line = text[: 4 * longest].strip().split("\n", 1)[0]
    return "".join(c if c.isprintable() else "\N{REPLACEMENT CHARACTER}" for c in line)[:longest]

"""A clock for processes that run in real time."""

from __future__ import annotations

import time


class WallClock:
    """Real time in seconds since the clock was created, independent of changes to the system's date."""

    def __init__(self) -> None:
        self._start = time.monotonic()

    def now(self) -> float:
        """Return the time [s]."""
        return time.monotonic() - self._start

    def sleep_until(self, moment: float) -> None:
        """Return when `now()` has reached `moment` [s]; at once if it has passed."""
        time.sleep(max(0.0, moment - self.now()))

"""Clocks: real time, or simulated time that passes as fast as possible."""

from __future__ import annotations

import time
from typing import Protocol


class Clock(Protocol):
    """Time in seconds since the clock was created."""

    def now(self) -> float: ...

    def sleep_until(self, moment: float) -> None:
        """Return when `now()` has reached `moment` [s]; at once if it has passed."""


class WallClock:
    """Real time, independent of changes to the system's date."""

    def __init__(self) -> None:
        self._start = time.monotonic()

    def now(self) -> float:
        return time.monotonic() - self._start

    def sleep_until(self, moment: float) -> None:
        time.sleep(max(0.0, moment - self.now()))


class SimulatedClock:
    """Simulated time, which passes only in `sleep_until`, without waiting."""

    def __init__(self, now: float = 0.0) -> None:
        self._now = now

    def now(self) -> float:
        return self._now

    def sleep_until(self, moment: float) -> None:
        self._now = max(self._now, moment)

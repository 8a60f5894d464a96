"""The time a process lives by: the wall's, or a simulation's that runs as fast as it can."""

from __future__ import annotations

import time
from typing import Protocol


class Clock(Protocol):
    """Seconds since the clock was made; waiting until a time."""

    def now(self) -> float: ...

    def sleep_until(self, moment: float) -> None:
        """Return when `now()` has reached `moment` [s]; at once if it has passed."""


class WallClock:
    """Real seconds; jumps of the system's date do not matter."""

    def __init__(self) -> None:
        self._start = time.monotonic()

    def now(self) -> float:
        return time.monotonic() - self._start

    def sleep_until(self, moment: float) -> None:
        time.sleep(max(0.0, moment - self.now()))


class SimulatedClock:
    """Time passes only by sleeping, and then at once."""

    def __init__(self, now: float = 0.0) -> None:
        self._now = now

    def now(self) -> float:
        return self._now

    def sleep_until(self, moment: float) -> None:
        self._now = max(self._now, moment)

"""How a flight keeps real time, and how an autopilot's clock is read by ours."""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass, field

import numpy as np

KEPT = 10_000  # latest beginnings whose lateness is remembered


@dataclass
class FlightTiming:
    """How real time was kept."""

    periods: int = 0
    late: int = 0  # begun more than `LATE` after their time
    slips: int = 0  # begun so late that the clock was set anew: the one before lasted two periods or more
    worst_gap: float = 0.0  # s between two setpoints
    round_trip: float = math.inf  # s to the autopilot and back, the fastest
    lost: int = 0  # periods whose telemetry, or whose mode, did not count
    lateness: deque[float] = field(default_factory=lambda: deque(maxlen=KEPT))  # s, of the beginnings of periods

    def figures(self) -> dict[str, float]:
        """For Health, in ms where it says so."""
        lateness = 1e3 * np.array([*self.lateness] or [0.0])
        return {
            "periods": self.periods,
            "periods late": self.late,
            "periods slipped": self.slips,
            "lateness p50 ms": float(np.percentile(lateness, 50)),
            "lateness p99 ms": float(np.percentile(lateness, 99)),
            "lateness worst ms": float(lateness.max()),
            "worst setpoint gap ms": 1e3 * self.worst_gap,
            "periods without telemetry": self.lost,
            **({"link round trip ms": 1e3 * self.round_trip} if math.isfinite(self.round_trip) else {}),
        }


class ClockOffset:
    """Our clock less the autopilot's [s], by the messages that came soonest.

    It falls at once and rises with the clocks' drift: milliseconds on a busy machine must not move it, for at 7 m/s
    each is 7 mm. Only when every message of a second is `JUMP` late the other clock has jumped: a simulator slips.
    """

    DRIFT = 1e-4  # s a second, at most, between two clocks
    JUMP = 0.05  # s

    def __init__(self) -> None:
        self.value = math.inf  # before the first message
        self._noted = self._second = -math.inf  # when the last message came, and when this second began
        self._soonest = math.inf  # in this second

    def note(self, now: float, theirs: float) -> None:
        """A message of their time `theirs` has come."""
        if now - self._second > 1.0:
            if self._soonest > self.value + self.JUMP:
                self.value = self._soonest
            self._second, self._soonest = now, math.inf
        late = now - theirs
        drifted = self.value + self.DRIFT * (now - self._noted) if math.isfinite(self.value) else math.inf
        self.value, self._noted, self._soonest = min(drifted, late), now, min(self._soonest, late)

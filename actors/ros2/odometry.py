"""Where a robot was lately: its odometry, and its state at any moment that this covers."""

from __future__ import annotations

import math
from collections import deque

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

KEPT = 2.0  # s
AHEAD = 0.1  # s beyond the newest odometry to which it is carried on by its own speeds
GAP = 0.15  # s between two odometries: of what was in a longer one nothing is known
STEP = 1e-4  # s: two odometries that are no farther apart are one
SLOPE = 0.1  # s over which speeds are taken from poses that come without any


class OdometryHistory:
    """Odometry by its own time stamps: rows of time [s], x, y [m], heading [rad], speed [m/s], turn rate [rad/s]."""

    def __init__(self, gap: float = GAP) -> None:
        self._rows: deque[tuple[float, ...]] = deque()
        self._gap = gap

    def __len__(self) -> int:
        return len(self._rows)

    @property
    def newest(self) -> float:
        """The last one's time [s]; -inf without any."""
        return self._rows[-1][0] if self._rows else -math.inf

    def add(self, time: float, x: float, y: float, heading: float, speed: float, turn_rate: float) -> bool:
        """False: not taken, for it holds something that is no finite number, or is not newer than the last one. One
        that is older by more than is kept begins anew: whoever measures was restarted."""
        return all(map(math.isfinite, (speed, turn_rate))) and self._add(time, x, y, heading, speed, turn_rate)

    def _add(self, time: float, x: float, y: float, heading: float, speed: float, turn_rate: float) -> bool:
        """Speeds that are no numbers are not known."""
        if not all(map(math.isfinite, (time, x, y, heading))):
            return False
        if time < self.newest - KEPT:
            self._rows.clear()
        if time <= self.newest + STEP:
            return False
        if self._rows:  # headings go on without jumps
            before = self._rows[-1][3]
            heading = before + (heading - before + math.pi) % (2.0 * math.pi) - math.pi
        self._rows.append((time, x, y, heading, speed, turn_rate))
        while self._rows[0][0] < time - KEPT:
            self._rows.popleft()
        return True

    def add_pose(self, time: float, x: float, y: float, heading: float) -> bool:
        """As `add`, for poses that come without speeds: they are the differences over the last `SLOPE` s, and not known
        before there are so many."""
        past = next((row for row in reversed(self._rows) if row[0] <= time - SLOPE), None)
        if past is None or time < self.newest or time - past[0] > SLOPE + self._gap:
            return self._add(time, x, y, heading, math.nan, math.nan)
        lasted = time - past[0]
        turned = (heading - past[3] + math.pi) % (2.0 * math.pi) - math.pi
        middle = past[3] + 0.5 * turned
        way = math.cos(middle) * (x - past[1]) + math.sin(middle) * (y - past[2])
        return self.add(time, x, y, heading, way / lasted, turned / lasted)

    def at(self, times: Array) -> Array | None:
        """States (n, 5) at times (n,); None: some time is not covered, or in a gap."""
        if not self._rows:
            return None
        rows = np.array(self._rows)
        if times.min() < rows[0, 0] - STEP or times.max() > rows[-1, 0] + AHEAD:
            return None
        after = np.searchsorted(rows[:, 0], times)
        between = after[(after > 0) & (after < len(rows))]
        if (rows[between, 0] - rows[between - 1, 0] > self._gap).any():
            return None
        states = np.stack([np.interp(times, rows[:, 0], rows[:, i]) for i in range(1, 6)], axis=1)
        ahead = np.maximum(times - rows[-1, 0], 0.0)
        middle = states[:, 2] + 0.5 * ahead * states[:, 4]
        states[:, 0] += ahead * states[:, 3] * np.cos(middle)
        states[:, 1] += ahead * states[:, 3] * np.sin(middle)
        states[:, 2] += ahead * states[:, 4]
        return states if np.isfinite(states).all() else None

    def state(self, time: float) -> Array | None:
        """(5,) at one time, the heading in [-π, π)."""
        states = self.at(np.array([time]))
        if states is None:
            return None
        state = np.asarray(states[0])
        state[2] = (state[2] + math.pi) % (2.0 * math.pi) - math.pi
        return state

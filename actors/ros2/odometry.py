"""Recent odometry of a robot, and its state at any time that the odometry covers."""

from __future__ import annotations

import math
from collections import deque

import numpy as np

from brakeline.messaging.robot import Array
from brakeline.sim.ground_estimator import wrap

HISTORY = 2.0  # s
EXTRAPOLATION = 0.1  # s after the newest odometry, for which the last speeds are assumed
LONGEST_GAP = 0.15  # s between two odometries, between which states are interpolated
SAME_TIME = 1e-4  # s: odometry that is not newer by more is dropped
SPEED_WINDOW = 0.1  # s over which speeds are computed from poses without speeds
TIME, X, Y, HEADING = range(4)  # columns of a row; speed [m/s] and turn rate [rad/s] follow


class OdometryHistory:
    """Odometry by its own time stamps: rows of time [s], x, y [m], heading [rad], speed [m/s], turn rate [rad/s]."""

    def __init__(self, gap: float = LONGEST_GAP) -> None:
        """gap: s, the longest between two odometries."""
        self._rows: deque[tuple[float, ...]] = deque()
        self._gap = gap

    def __len__(self) -> int:
        return len(self._rows)

    @property
    def newest(self) -> float:
        """Time of the newest odometry [s]; -inf without any."""
        return self._rows[-1][TIME] if self._rows else -math.inf

    def add(self, time: float, x: float, y: float, heading: float, speed: float, turn_rate: float) -> bool:
        """Add an odometry. Return False if it is dropped: a number is not finite, or it is not newer than the last one.

        An odometry that is older by more than `HISTORY` begins a new history: its sender has restarted.
        """
        return all(map(math.isfinite, (speed, turn_rate))) and self._add(time, x, y, heading, speed, turn_rate)

    def add_pose(self, time: float, x: float, y: float, heading: float) -> bool:
        """Add a pose without speeds, see `add`. The speeds come from the poses of the last `SPEED_WINDOW` seconds."""
        past = next((row for row in reversed(self._rows) if row[TIME] <= time - SPEED_WINDOW), None)
        if past is None or time < self.newest or time - past[TIME] > SPEED_WINDOW + self._gap:
            return self._add(time, x, y, heading, math.nan, math.nan)
        duration, turn = time - past[TIME], wrap(heading - past[HEADING])
        middle = past[HEADING] + 0.5 * turn
        distance = math.cos(middle) * (x - past[X]) + math.sin(middle) * (y - past[Y])
        return self.add(time, x, y, heading, distance / duration, turn / duration)

    def at(self, times: Array) -> Array | None:
        """Return the states (n, 5) at some times (n,) [s]; None if one of them is not covered, or in a gap."""
        if not self._rows:
            return None
        rows = np.array(self._rows)
        if times.min() < rows[0, TIME] - SAME_TIME or times.max() > rows[-1, TIME] + EXTRAPOLATION:
            return None
        after = np.searchsorted(rows[:, TIME], times)
        between = after[(after > 0) & (after < len(rows))]
        if (rows[between, TIME] - rows[between - 1, TIME] > self._gap).any():
            return None
        x, y, heading, speed, turn_rate = (np.interp(times, rows[:, TIME], rows[:, i]) for i in range(X, 6))
        ahead = np.maximum(times - rows[-1, TIME], 0.0)
        middle = heading + 0.5 * ahead * turn_rate
        x, y = x + ahead * speed * np.cos(middle), y + ahead * speed * np.sin(middle)
        states = np.stack([x, y, heading + ahead * turn_rate, speed, turn_rate], axis=1)
        return states if np.isfinite(states).all() else None

    def state(self, time: float) -> Array | None:
        """Return the state (5,) at a time [s], with its heading in [-π, π); None, see `at`."""
        states = self.at(np.array([time]))
        if states is None:
            return None
        state = np.asarray(states[0])
        state[2] = wrap(state[2])
        return state

    def _add(self, time: float, x: float, y: float, heading: float, speed: float, turn_rate: float) -> bool:
        """Add an odometry whose speeds may be NaN: unknown."""
        if not all(map(math.isfinite, (time, x, y, heading))):
            return False
        if time < self.newest - HISTORY:
            self._rows.clear()
        if time <= self.newest + SAME_TIME:
            return False
        if self._rows:  # interpolation needs headings without jumps
            before = self._rows[-1][HEADING]
            heading = before + wrap(heading - before)
        self._rows.append((time, x, y, heading, speed, turn_rate))
        while self._rows[0][TIME] < time - HISTORY:
            self._rows.popleft()
        return True

"""Recent odometry of a robot, and its state at any time that the odometry covers."""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass

import numpy as np

from brakeline.messaging.robot import Array, Robot
from brakeline.sim.ground_estimator import wrap

HISTORY = 2.0  # s
EXTRAPOLATION = 0.1  # s after the newest odometry, for which the last speeds are assumed
LONGEST_GAP = 0.15  # s between two odometries, between which states are interpolated
SAME_TIME = 1e-4  # s: odometry that is not newer by more is dropped
SPEED_WINDOW = 0.1  # s over which speeds are computed from poses without speeds
FASTER = 2.0  # than its inputs allow, a robot may move between two odometries, as downhill or with a late stamp
LARGER_ERRORS = 4.0  # than one measurement's, the errors of two odometries may be together
MOST_INPUTS = 64  # that are remembered: a robot that brakes changes its input a few times, and then stands
TIME, X, Y, HEADING = range(4)  # columns of a row; speed [m/s] and turn rate [rad/s] follow


@dataclass(frozen=True)
class StepLimits:
    """The largest step between two odometries: rates in m/s and rad/s, plus an allowance in m and rad for errors.

    Without odometry a robot brakes. So it moves for `braking` seconds at most, however long a gap is, and no farther
    than its inputs meanwhile: a pose farther away comes from a sender that has restarted. An input acts for `settling`
    seconds after the next one has replaced it.
    """

    speed: float
    turn_rate: float
    position: float
    heading: float
    braking: float
    settling: float

    @staticmethod
    def of(robot: Robot, gap: float = LONGEST_GAP) -> StepLimits:
        """Return the limits of a robot that drives in the plane by speed and turn rate. gap: see `OdometryHistory`."""
        speed, turn_rate = (FASTER * float(most) for most in np.maximum(np.abs(robot.low()), np.abs(robot.high())))
        x, y, heading = (LARGER_ERRORS * robot.measurement_bound[i] for i in range(3))
        braking, settling = robot.horizon + 1, robot.horizon - robot.free_steps  # periods
        return StepLimits(
            speed, turn_rate, math.hypot(x, y), heading, gap + braking * robot.period, settling * robot.period
        )

    def allow(
        self, duration: float, distance: float, turn: float, way: float = math.inf, arc: float = math.inf
    ) -> bool:
        """Return whether a robot can move so far [m], and turn so far [rad], in a time [s].

        way [m], arc [rad]: of the inputs in this time; infinite if they are not known.
        """
        moving = min(duration, self.braking)
        far = distance > self.position + min(self.speed * moving, FASTER * way)
        return not (far or turn > self.heading + min(self.turn_rate * moving, FASTER * arc))


class OdometryHistory:
    """Odometry by its own time stamps: rows of time [s], x, y [m], heading [rad], speed [m/s], turn rate [rad/s].

    Attributes:
        jump: why the history began anew, since the caller emptied this text. A pose that jumps while its time goes on
            is in another frame, as after a localisation that was set anew: nothing connects it with the poses before.
    """

    def __init__(self, limits: StepLimits, gap: float = LONGEST_GAP) -> None:
        """limits: the largest step between two odometries. gap: s, the longest time between them."""
        self._rows: deque[tuple[float, ...]] = deque()
        self._inputs: deque[tuple[float, float, float]] = deque(maxlen=MOST_INPUTS)  # see `executed`
        self._limits, self._gap = limits, gap
        self.jump = ""

    @property
    def newest(self) -> float:
        """Time of the newest odometry [s]; -inf without any."""
        return self._rows[-1][TIME] if self._rows else -math.inf

    def executed(self, time: float, speed: float, turn_rate: float) -> None:
        """Note that the robot executes an input, [m/s] and [rad/s], from a time [s] on."""
        if not self._inputs or self._inputs[-1][1:] != (abs(speed), abs(turn_rate)):
            self._inputs.append((time, abs(speed), abs(turn_rate)))

    def add(self, time: float, x: float, y: float, heading: float, speed: float, turn_rate: float) -> None:
        """Add an odometry, unless a number is not finite, or it is not newer than the last one.

        An odometry that is older by more than `HISTORY`, or whose pose the robot can't have reached, begins a new
        history: its sender has restarted, or was set.
        """
        if all(map(math.isfinite, (speed, turn_rate))) and self._admit(time, x, y, heading):
            self._append(time, x, y, heading, speed, turn_rate)

    def add_pose(self, time: float, x: float, y: float, heading: float) -> None:
        """Add a pose without speeds, see `add`. The speeds come from the poses of the last `SPEED_WINDOW` seconds."""
        if not self._admit(time, x, y, heading):
            return
        past = next((row for row in reversed(self._rows) if row[TIME] <= time - SPEED_WINDOW), None)
        if past is None or time - past[TIME] > SPEED_WINDOW + self._gap:
            self._append(time, x, y, heading, math.nan, math.nan)
            return
        duration, turn = time - past[TIME], wrap(heading - past[HEADING])
        middle = past[HEADING] + 0.5 * turn
        distance = math.cos(middle) * (x - past[X]) + math.sin(middle) * (y - past[Y])
        self._append(time, x, y, heading, distance / duration, turn / duration)

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

    def _admit(self, time: float, x: float, y: float, heading: float) -> bool:
        """Return whether a pose counts, and begin a new history if it is not connected with the last one."""
        if not all(map(math.isfinite, (time, x, y, heading))):
            return False
        if time < self.newest - HISTORY:
            self._begin_anew(f"the time of the odometry went back by {self.newest - time:.2f} s")
        if time <= self.newest + SAME_TIME:
            return False
        if self._rows:
            last, duration = self._rows[-1], time - self.newest
            distance, turn = math.hypot(x - last[X], y - last[Y]), abs(wrap(heading - last[HEADING]))
            inputs = self._inputs_between(self.newest, time) if duration > self._gap else (math.inf, math.inf)
            if not self._limits.allow(duration, distance, turn, *inputs):
                self._begin_anew(
                    f"the pose jumped by {distance:.2f} m and {turn:.2f} rad within {duration:.2f} s, "
                    "which this robot can't have done"
                )
        return True

    def _inputs_between(self, since: float, until: float) -> tuple[float, float]:
        """Return the way [m] and the arc [rad] of the inputs between two times [s]; infinite if one is not known."""
        since -= self._limits.settling
        if not self._inputs or self._inputs[0][0] > since:
            return math.inf, math.inf
        times, *rates = np.array(self._inputs).T
        spans = np.diff(np.clip(np.append(times, until), since, until))
        return float(spans @ rates[0]), float(spans @ rates[1])

    def _begin_anew(self, why: str) -> None:
        self._rows.clear()
        self.jump = self.jump or why

    def _append(self, time: float, x: float, y: float, heading: float, speed: float, turn_rate: float) -> None:
        """Append an odometry whose speeds may be NaN: unknown."""
        if self._rows:  # interpolation needs headings without jumps
            before = self._rows[-1][HEADING]
            heading = before + wrap(heading - before)
        self._rows.append((time, x, y, heading, speed, turn_rate))
        while self._rows[0][TIME] < time - HISTORY:
            self._rows.popleft()

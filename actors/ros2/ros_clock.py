"""The clock of a ROS graph: the system time, or a simulation's time on /clock."""

from __future__ import annotations

import threading
import time

from brakeline.messaging.ros2.cdr_messages import Clock, seconds

JUMP = 0.05  # s: a smaller difference to the system time counts as drift
POLL = 0.02  # s between two checks whether to stop
ROUNDING = 1e-9  # s


class SystemClock:
    """This machine's time. It runs evenly between two calls of `jumped`, even if the system's time is set."""

    def __init__(self) -> None:
        self._offset = time.time() - time.monotonic()

    def now(self) -> float:
        """Return the time [s]: since the Unix epoch, or since the beginning of a simulation."""
        return time.monotonic() + self._offset

    def wait(self, moment: float, stop: threading.Event, patience: float) -> bool:
        """Wait for a moment [s]. Return False if `stop` is set, or if the clock stood still for `patience` s."""
        return not stop.wait(max(0.0, moment - self.now()))

    def jumped(self) -> float:
        """Return by how many seconds the clock was set since the last call, and adopt the new time."""
        difference = time.time() - self.now()
        if abs(difference) < JUMP:
            return 0.0
        self._offset += difference
        return difference


class RosSimulatedClock(SystemClock):
    """The time on /clock; 0 before the first message."""

    RESTART = 1.0  # s: a clock that goes back by more has restarted

    def __init__(self) -> None:
        self._now = 0.0
        self._moved = threading.Condition()
        self._jump = 0.0

    def on_clock(self, message: Clock) -> None:
        """Handle a message on /clock."""
        with self._moved:
            stamp = seconds(message.clock)
            if stamp < self._now - self.RESTART:
                self._jump += stamp - self._now
                self._now = stamp
            self._now = max(self._now, stamp)
            self._moved.notify_all()

    def now(self) -> float:
        return self._now

    def wait(self, moment: float, stop: threading.Event, patience: float) -> bool:
        with self._moved:
            last, since = self._now, time.monotonic()
            while self._now < moment - ROUNDING and not self._jump:
                self._moved.wait(POLL)
                if self._now != last:
                    last, since = self._now, time.monotonic()
                if stop.is_set() or time.monotonic() - since > patience:
                    return False
        return not stop.is_set()

    def jumped(self) -> float:
        with self._moved:
            jump, self._jump = self._jump, 0.0
        return jump

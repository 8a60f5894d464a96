"""The time that a ROS graph lives by: this machine's date, or a simulation's on /clock."""

from __future__ import annotations

import threading
import time
from typing import Protocol

from brakeline.messaging.ros2.cdr_messages import Clock, seconds

JUMP = 0.05  # s: a date that is off by less is left to drift
SLICE = 0.02  # s between two looks at whether to stop


class RosClock(Protocol):
    """Seconds since the Unix epoch, or since the simulation's beginning."""

    def now(self) -> float: ...

    def wait(self, moment: float, stop: threading.Event, patience: float) -> bool:
        """Until `now()` has reached the moment. False: asked to stop, or for `patience` s it stood still."""

    def jumped(self) -> float:
        """By how much it was set since the last call [s]; what was to come is later by as much."""


class SystemClock:
    """This machine's. In between it runs evenly: who sets the date must not stop whoever waits."""

    def __init__(self) -> None:
        self._offset = time.time() - time.monotonic()

    def now(self) -> float:
        return time.monotonic() + self._offset

    def wait(self, moment: float, stop: threading.Event, patience: float) -> bool:
        return not stop.wait(max(0.0, moment - self.now()))

    def jumped(self) -> float:
        off = time.time() - self.now()
        if abs(off) < JUMP:
            return 0.0
        self._offset += off
        return off


class SimulatedClock:
    """What /clock says."""

    BACK = 1.0  # s: a clock that goes back by more was begun anew

    def __init__(self) -> None:
        self._now = 0.0
        self._moved = threading.Condition()
        self._jump = 0.0

    def hear(self, message: Clock) -> None:
        with self._moved:
            told = seconds(message.clock)
            if told < self._now - self.BACK:
                self._jump += told - self._now
                self._now = told
            self._now = max(self._now, told)
            self._moved.notify_all()

    def now(self) -> float:
        return self._now

    def wait(self, moment: float, stop: threading.Event, patience: float) -> bool:
        with self._moved:
            seen, since = self._now, time.monotonic()
            while self._now < moment - 1e-9 and not self._jump:
                self._moved.wait(SLICE)
                if self._now != seen:
                    seen, since = self._now, time.monotonic()
                if stop.is_set() or time.monotonic() - since > patience:
                    return False
        return not stop.is_set()

    def jumped(self) -> float:
        with self._moved:
            jump, self._jump = self._jump, 0.0
        return jump

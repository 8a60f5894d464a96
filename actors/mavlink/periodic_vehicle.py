"""A vehicle in real time: one thread begins its control periods, and other threads wait for them."""

from __future__ import annotations

import threading
from dataclasses import dataclass, replace

from brakeline.actors.mavlink.telemetry import Array
from brakeline.errors import MavlinkError
from brakeline.messaging.robot import Robot
from brakeline.sim.vehicle import Period


@dataclass(frozen=True)
class ControlPeriod:
    """One control period, at the moment when it begins."""

    number: int  # the first is 0; a missed period leaves out its number
    input: Array  # (3,) m/s, in force from this moment on
    report: Period  # the outcome of the period before
    lost: str = ""  # why telemetry does not count, or the autopilot does not follow our setpoints; empty: all is well


class PeriodicVehicle:
    """The current control period of a vehicle, and the error after which nobody flies it any more."""

    def __init__(self, robot: Robot) -> None:
        self._robot, self._changed = robot, threading.Condition()
        self._current: ControlPeriod | None = None
        self._last_lost: ControlPeriod | None = None
        self.failure: Exception | None = None  # after which nobody flies the vehicle any more

    @property
    def current_period(self) -> ControlPeriod:
        """The latest control period."""
        assert self._current is not None, "no period has begun"
        return self._current

    @property
    def failed(self) -> bool:
        """Whether nobody flies the vehicle any more."""
        return self.failure is not None

    def wait(self, number: int) -> ControlPeriod:
        """Wait until period `number` has begun, and return the current period. It is lost if one since `number` was.

        Raises:
            MavlinkError: the period does not begin in time, or nobody flies the vehicle any more.
        """
        with self._changed:
            patience = 2.0 + self._robot.period * max(0, number - self.current_period.number)
            if not self._changed.wait_for(lambda: self.failed or self.current_period.number >= number, patience):
                raise MavlinkError(f"period {number} does not begin")
            self.check()
            period, lost = self.current_period, self._last_lost
            return period if lost is None or lost.number < number else replace(period, lost=lost.lost)

    def check(self) -> None:
        """Raise the error after which nobody flies the vehicle any more, if there is one."""
        if self.failure is not None:
            raise self.failure

    def _begin(self, period: ControlPeriod) -> None:
        with self._changed:
            self._current = period
            self._last_lost = period if period.lost else self._last_lost
            self._changed.notify_all()

    def _fail(self, error: Exception) -> None:
        with self._changed:
            self.failure = self.failure or error
            self._changed.notify_all()

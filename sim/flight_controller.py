"""The quadrotor's flight controller: velocity setpoint -> acceleration -> attitude and thrust -> body rates -> rotors.

The reference of each axis is the setpoint after three moving averages in a row, over `ramp`, `round` and `ease`
seconds (`Gains`). A staircase with a step every `ramp` seconds becomes a straight line, so the acceleration has no
ripple. `round` bounds the jerk and `ease` the snap. The reference forgets the past after the sum of the three times, so
the closed loop is nearly linear and has a short memory.

`brakeline.sim.kernels.flight_kernels` has the loops, compiled: Python takes many times as long.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from brakeline.sim.kernels.flight_kernels import AIRFRAME, CONTROLLER, GAINS, GRAVITY, Airframe, control

Array = NDArray[np.float64]
Controllers = NDArray[Any]  # (N,) records of `CONTROLLER`
Vector = tuple[float, float, float]

STILL: Vector = (0.0, 0.0, 0.0)


def controllers_at_rest(size: int) -> Controllers:
    """Return controllers (size,) at rest, with the heading zero and no position to hold."""
    rest: Controllers = np.zeros(size, CONTROLLER).view(np.recarray)
    rest["allowance"] = GAINS.jump
    rest["force"][:, 0, 2] = GRAVITY
    return rest


class FlightController:
    """Follows velocity setpoints; at the setpoint zero, the vehicle stops and holds its position."""

    body: Airframe = AIRFRAME

    def __init__(self) -> None:
        """Start at rest."""
        self.record = controllers_at_rest(1)  # the state of the controller, (1,) of `CONTROLLER`
        self._fields = self.record.view(np.ndarray)  # the same, without the slow attributes of a record array

    def reset(self, yaw: float = 0.0) -> None:
        """Start at rest with a heading [rad]."""
        self.record[:] = controllers_at_rest(1)
        self._fields["yaw"] = self._fields["yaw_goal"] = yaw

    @property
    def setpoint(self) -> Vector:
        """The velocity setpoint [m/s]."""
        x, y, z = self._fields["setpoint"][0].tolist()
        return (x, y, z)

    @setpoint.setter
    def setpoint(self, velocity: Vector) -> None:
        self._fields["setpoint"] = velocity

    def turn_to(self, yaw: float) -> None:
        """Turn the reference of the heading to `yaw` [rad from east]."""
        self._fields["yaw_goal"] = yaw

    def turn_at(self, yaw_rate: float) -> None:
        """Turn the reference of the heading at a rate [rad/s], until the rate is zero."""
        self._fields["yaw_rate"] = yaw_rate

    def hold(self, position: Array, integral: Array) -> None:
        """Hold a position (3,) [m] from the start, with an integral term (3,) [m/s²]."""
        self._fields["hold"], self._fields["holds"], self._fields["integral"] = position, True, integral

    def update(self, qpos: Array, qvel: Array, errors: Array, thrusts: Array) -> None:
        """Write the thrusts (4,) [N] of the rotors for a physics step; see `flight_kernels` for the arguments."""
        control(self.record, qpos, qvel, errors, thrusts)

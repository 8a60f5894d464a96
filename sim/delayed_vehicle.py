"""What real time does to a vehicle, in simulation: while the next input is decided on, the last is carried out."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from brakeline.messaging.robot import Robot
from brakeline.sim.arena import Arena
from brakeline.sim.vehicle import BadInput, MakeVehicle, Period, Vehicle

Array = NDArray[np.float64]


class DelayedVehicle:
    """A vehicle that carries out each input one period after it was given; at first, zero.

    `input` is the one in force, which `step` carries out while its argument waits for its turn.
    """

    def __init__(self, vehicle: Vehicle, robot: Robot) -> None:
        self._vehicle, self._robot = vehicle, robot
        self.input: Array = np.zeros(robot.action_dim)

    @property
    def true(self) -> Array:
        """(n,) the state as it is."""
        return self._vehicle.true

    @property
    def measured(self) -> Array:
        """(n,) the state as it is estimated."""
        return self._vehicle.measured

    def step(self, input: Array) -> Period:
        """A period at the input in force; the argument, clipped to bounds and slew, is in force from its end on.

        Raises:
            BadInput: when the input is not m finite numbers.
        """
        robot, wanted = self._robot, np.asarray(input, dtype=np.float64)
        if wanted.shape != (robot.action_dim,) or not np.isfinite(wanted).all():
            raise BadInput(f"an input is {robot.action_dim} finite numbers, not {input!r}")
        period = self._vehicle.step(self.input)
        slew = np.asarray(robot.action_slew)
        self.input = np.clip(np.clip(wanted, robot.low(), robot.high()), self.input - slew, self.input + slew)
        return period

    def initial_period(self) -> Period:
        """The present state as a period in which nothing happened."""
        return self._vehicle.initial_period()

    def alter(self, **changes: float) -> None:
        """As the vehicle's own."""
        self._vehicle.alter(**changes)


def delayed(make: MakeVehicle, robot: Robot) -> MakeVehicle:
    """Makes the same vehicles for a robot in real time."""

    def make_late(arena: Arena, rng: np.random.Generator) -> DelayedVehicle:
        return DelayedVehicle(make(arena, rng), robot)

    return make_late

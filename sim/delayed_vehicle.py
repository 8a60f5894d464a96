"""Simulate the delay of real time: a vehicle carries out each input one period after the policy chose it."""

from __future__ import annotations

import numpy as np

from brakeline.messaging.obstacle import Array
from brakeline.messaging.robot import Robot
from brakeline.messaging.task import RobotWithTask
from brakeline.sim.sim_conditions import Conditions
from brakeline.sim.vehicle import MakeVehicle, Period, Vehicle


class DelayedVehicle:
    """A vehicle that carries out each input one period later; zero during the first period.

    `input` is the input in force: `step` carries it out, while the argument of `step` waits for the next period.
    """

    def __init__(self, vehicle: Vehicle, robot: Robot) -> None:
        self._vehicle, self._robot = vehicle, robot
        self.input: Array = np.zeros(robot.action_dim)
        self.initial_period, self.alter = vehicle.initial_period, vehicle.alter

    @property
    def true(self) -> Array:
        return self._vehicle.true

    @property
    def measured(self) -> Array:
        return self._vehicle.measured

    def step(self, input: Array) -> Period:
        """Carry out the input in force for one period, then put the argument (m,), clipped, in force."""
        following = self._robot.clip_input(input, self.input)
        period = self._vehicle.step(self.input)
        self.input = following
        return period


def delayed(make: MakeVehicle, robot: Robot) -> MakeVehicle:
    """Return a function that makes the same vehicles with the delay of real time."""

    return lambda arena, rng: DelayedVehicle(make(arena, rng), robot)


def simulated_vehicle(robot: RobotWithTask, conditions: Conditions, tap: object = None) -> MakeVehicle:
    """Return a function that makes the vehicles of a robot's task under some conditions.

    A robot in real time gets delayed vehicles. A simulator behind MAVLink calls `tap` with every frame.

    Raises:
        UnknownTask: the code that the task names cannot be loaded.
    """
    if robot.late:
        return delayed(simulated_vehicle(robot.in_lockstep(), conditions, tap), robot)
    make: MakeVehicle = robot.task.code(robot.task.simulator)(conditions, tap)
    return make

"""Simulate the delay of real time: a vehicle carries out each input one period after the policy chose it."""

from __future__ import annotations

from inspect import signature

import numpy as np

from brakeline.errors import Mismatch
from brakeline.messaging.obstacle import Array
from brakeline.messaging.robot import Robot
from brakeline.messaging.task import RobotWithTask
from brakeline.sim.sim_conditions import Conditions
from brakeline.sim.vehicle import MakeVehicle, Period, Vehicle

LEARNED = "brakeline.deploy.learned_vehicle:simulated"


class DelayedVehicle:
    """A vehicle that carries out each input one period later; zero during the first period.

    `input` is the input in force: `step` carries it out, while the argument of `step` waits for the next period.
    """

    def __init__(self, vehicle: Vehicle, robot: Robot) -> None:
        self._vehicle, self._robot = vehicle, robot
        self.input: Array = np.zeros(robot.action_dim)
        self.initial_period, self.alter = vehicle.initial_period, vehicle.alter
        self.acceleration_age = acceleration_age_of(vehicle)

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


def acceleration_age_of(vehicle: Vehicle) -> float:
    """Return the age of the horizontal acceleration in a vehicle's measured states [s]; 0 if it states none."""
    return float(getattr(vehicle, "acceleration_age", 0.0))


def delayed(make: MakeVehicle, robot: Robot) -> MakeVehicle:
    """Return a function that makes the same vehicles with the delay of real time."""

    return lambda arena, rng: DelayedVehicle(make(arena, rng), robot)


def simulated_vehicle(robot: RobotWithTask, conditions: Conditions, tap: object = None) -> MakeVehicle:
    """Return a function that makes the vehicles of a robot's task under some conditions.

    A robot in real time gets delayed vehicles. A simulator behind MAVLink calls `tap` with every frame. A simulator
    that has an argument `robot` gets the robot, and can refuse what it cannot simulate. With `conditions.learned`, the
    robot's model set simulates it.

    Raises:
        UnknownTask: the code that the task names cannot be loaded.
        Mismatch: the simulator moves another robot than the one that the description states.
    """
    make: MakeVehicle
    if conditions.learned:  # of a robot in real time, the data are its own
        make = robot.task.code(LEARNED)(conditions, tap, robot=robot)
        return delayed(make, robot) if robot.late else make
    if robot.late:
        return delayed(simulated_vehicle(robot.in_lockstep(), conditions, tap), robot)
    code = robot.task.code(robot.task.simulator)
    described = {"robot": robot} if "robot" in signature(code).parameters else {}
    make = code(conditions, tap, **described)
    return make


def check_described(robot: Robot, simulated: Robot) -> None:
    """Check a description of `robot` against that of the robot that a simulator moves.

    Raises:
        Mismatch: the simulator can't move as `robot` states, or its body reaches farther.
    """
    (low, high), (least, most) = robot.bounds, simulated.bounds
    sizes = [(one.state_dim, one.action_dim) for one in (robot, simulated)]
    if sizes[0] != sizes[1]:
        why = f"has {sizes[1][0]} coordinates and {sizes[1][1]} inputs, not {sizes[0][0]} and {sizes[0][1]}"
    elif robot.period != simulated.period:
        why = f"has a period of {simulated.period:g} s, not {robot.period:g} s"
    elif (low < least).any() or (high > most).any() or (robot.slew > simulated.slew).any():
        why = "clips inputs to narrower bounds or to a smaller slew"
    elif robot.footprint < simulated.footprint:  # the filter would keep too little clear
        why = f"has a body that reaches {simulated.footprint:g} m from its position, not {robot.footprint:g} m"
    else:
        return
    raise Mismatch(
        f"{robot.name}: the simulated {simulated.name} {why}: correct the description, or name another simulator in "
        "the task file"
    )

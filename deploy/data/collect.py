"""`brakeline collect`: record the data that the filter learns a robot from."""

from __future__ import annotations

import itertools
from collections.abc import Iterator

import numpy as np

from brakeline.deploy.data.excitation import excitation
from brakeline.deploy.vehicle_factory import vehicle_in_empty_arena
from brakeline.messaging.robot import Robot
from brakeline.messaging.task import RobotWithTask
from brakeline.safety.model.dataset import Dataset, Trajectory
from brakeline.sim.sim_conditions import Conditions

PERIODS = 300  # a trajectory
ORIGIN = "collect"


def record(
    robot: RobotWithTask, trajectories: int, seed: int, conditions: Conditions, first: int = 0
) -> Iterator[Trajectory]:
    """Drive trajectories from number `first` on, each from standing still, with its own generator: (seed, number)."""
    for number in range(first, trajectories):
        rng = np.random.default_rng((seed, number))
        vehicle = vehicle_in_empty_arena(robot, rng, conditions)
        states, inputs, paths, turned = [vehicle.measured], [], [], []
        for u in itertools.islice(excitation(robot, rng), PERIODS):
            period = vehicle.step(u)
            if period.collision:
                raise RuntimeError(f"trajectory {number} touched something: the yard is too small")
            states.append(period.measured)
            inputs.append(vehicle.input)
            paths.append(period.subsamples)
            turned.append(period.turned)
        yield Trajectory(*(np.array(values) for values in (states, inputs, paths, turned)))


def dataset(robot: Robot, trajectories: list[Trajectory], seed: int, conditions: Conditions) -> Dataset:
    """The trajectories as a checked data set that says where it comes from."""
    data = Dataset(robot, tuple(trajectories), origin(seed, conditions))
    data.check()
    return data


def origin(seed: int, conditions: Conditions) -> dict[str, str]:
    """What a recorded data set says of itself."""
    return conditions.describe() | {"seed": str(seed), "origin": ORIGIN}

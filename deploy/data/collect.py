"""Record trajectories of a simulated robot: the data of its model set (`brakeline collect`)."""

from __future__ import annotations

import itertools
from collections.abc import Iterator

import numpy as np

from brakeline.deploy.data.excitation import excitation
from brakeline.deploy.data.trajectory_builder import TrajectoryBuilder
from brakeline.deploy.vehicle_factory import vehicle_in_empty_arena
from brakeline.messaging.robot import Robot
from brakeline.messaging.task import RobotWithTask
from brakeline.safety.model.dataset import Dataset, Trajectory
from brakeline.sim.sim_conditions import Conditions

PERIODS = 300  # per trajectory
ORIGIN = "collect"


def record(
    robot: RobotWithTask, trajectories: int, seed: int, conditions: Conditions, first: int = 0
) -> Iterator[Trajectory]:
    """Yield trajectories `first` to `trajectories` - 1 from the robot's simulator.

    Each one begins at rest and has its own random generator, seeded with (seed, number). Therefore a recording that
    was interrupted can continue and give the same data.

    Raises:
        RuntimeError: the robot touched something.
    """
    for number in range(first, trajectories):
        rng = np.random.default_rng((seed, number))
        vehicle = vehicle_in_empty_arena(robot, rng, conditions)
        built = TrajectoryBuilder(vehicle.measured)
        for u in itertools.islice(excitation(robot, rng), PERIODS):
            period = vehicle.step(u)
            if period.collision:
                raise RuntimeError(
                    f"trajectory {number} touched something: the recording yard is too small for the robot"
                )
            built.add(vehicle.input, period.measured, period.subsamples, period.turned)
        yield built.trajectory()


def dataset(robot: Robot, trajectories: list[Trajectory], seed: int, conditions: Conditions) -> Dataset:
    """Return the trajectories as a checked data set, with its origin in `about`."""
    data = Dataset(robot, tuple(trajectories), origin(seed, conditions))
    data.check()
    return data


def origin(seed: int, conditions: Conditions) -> dict[str, str]:
    """Return the `about` entries of a simulated recording: conditions, seed and origin."""
    return conditions.describe() | {"seed": str(seed), "origin": ORIGIN}

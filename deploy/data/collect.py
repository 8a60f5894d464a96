"""Record trajectories of a simulated robot: the data of its model set (`brakeline collect`)."""

from __future__ import annotations

import itertools
from collections.abc import Iterator

import numpy as np

from brakeline.deploy.data.excitation import excitation, restless_excitation
from brakeline.deploy.data.recording_origin import origin
from brakeline.deploy.data.trajectory_builder import TrajectoryBuilder
from brakeline.deploy.vehicle_factory import vehicle_in_empty_arena
from brakeline.messaging.task import RobotWithTask
from brakeline.safety.model.dataset import Dataset, Trajectory
from brakeline.sim.sim_conditions import Conditions

PERIODS, RESTLESS_PERIODS = 300, 120  # per trajectory; the restless ones are short, so there are many starts


def record(
    robot: RobotWithTask, trajectories: int, seed: int, conditions: Conditions, first: int = 0, restless: int = 0
) -> Iterator[Trajectory]:
    """Yield trajectories from the robot's simulator, and after them `restless` short ones of restless driving.

    Each one begins at rest and has its own random generator, seeded with (seed, number). Therefore a recording that
    was interrupted can continue and give the same data: `first` trajectories exist already.

    Raises:
        RuntimeError: the robot touched something.
    """
    for number in range(first, trajectories + restless):
        steady = number < trajectories
        rng = np.random.default_rng((seed, number) if steady else (seed, number - trajectories, 1))
        vehicle = vehicle_in_empty_arena(robot, rng, conditions)
        built = TrajectoryBuilder(vehicle.measured)
        inputs = excitation(robot, rng) if steady else restless_excitation(robot, rng)
        for u in itertools.islice(inputs, PERIODS if steady else RESTLESS_PERIODS):
            period = vehicle.step(u)
            if period.collision:
                raise RuntimeError(
                    f"trajectory {number} touched something: the recording yard is too small for the robot"
                )
            built.add(vehicle.input, period.measured, period.subsamples, period.turned)
        yield built.trajectory()


def dataset(
    robot: RobotWithTask, trajectories: list[Trajectory], seed: int, conditions: Conditions, restless: int = 0
) -> Dataset:
    """Return the trajectories as a checked data set, with its origin in `about`."""
    data = Dataset(robot, tuple(trajectories), origin(robot, seed, conditions, restless))
    data.check()
    return data

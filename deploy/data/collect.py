"""Record trajectories of a simulated robot: the data of its model set (`brakeline collect`)."""

from __future__ import annotations

import itertools
import os
from collections.abc import Generator, Iterator, Sequence
from contextlib import closing
from dataclasses import dataclass

import numpy as np

from brakeline.deploy.data.excitation import excitation, restless_excitation
from brakeline.deploy.data.recording_origin import origin
from brakeline.deploy.data.trajectory_builder import TrajectoryBuilder
from brakeline.deploy.vehicle_factory import empty_arena_at_random, vehicle_in_empty_arena
from brakeline.errors import NoBatch
from brakeline.messaging.robot import Array
from brakeline.messaging.task import RobotWithTask
from brakeline.safety.model.dataset import Dataset, Trajectory
from brakeline.sim.sim_conditions import Conditions

PERIODS, RESTLESS_PERIODS = 300, 120  # per trajectory; the restless ones are short, so there are many starts
AT_ONCE = 50  # trajectories that a batch records
THREADS = min(8, os.cpu_count() or 1)  # for the physics of a batch


@dataclass(frozen=True)
class _Recipe:
    """A trajectory to record: its number, its random generator, and whether the robot drives restlessly."""

    number: int
    rng: np.random.Generator
    restless: bool

    @property
    def periods(self) -> int:
        return RESTLESS_PERIODS if self.restless else PERIODS

    def inputs(self, robot: RobotWithTask) -> Generator[Array, Array | None, None]:
        return restless_excitation(robot, self.rng) if self.restless else excitation(robot, self.rng)

    def check(self, collision: bool) -> None:
        if collision:
            raise RuntimeError(
                f"trajectory {self.number} touched something: the recording yard is too small for the robot"
            )


def record(
    robot: RobotWithTask, trajectories: int, seed: int, conditions: Conditions, first: int = 0, restless: int = 0
) -> Iterator[Trajectory]:
    """Yield the trajectories of `record_parts` one by one."""
    return itertools.chain.from_iterable(record_parts(robot, trajectories, seed, conditions, first, restless))


def record_parts(
    robot: RobotWithTask, trajectories: int, seed: int, conditions: Conditions, first: int = 0, restless: int = 0
) -> Iterator[list[Trajectory]]:
    """Yield trajectories from the robot's simulator, and after them `restless` short ones of restless driving.

    The trajectories of a part end at the same time. Save them before you ask for the next part, which takes a while.

    Each trajectory begins at rest and has its own random generator, seeded with (seed, number). Therefore a recording
    that was interrupted can continue and give the same data: `first` trajectories exist already. Many robots at once,
    where a batch simulates them, give what one after the other gives, up to rounding.

    Raises:
        RuntimeError: the robot touched something.
    """
    from brakeline.sim.batch.batch_support import check_vehicles

    keys = [(seed, k) for k in range(trajectories)] + [(seed, k, 1) for k in range(restless)]
    recipes = [_Recipe(k, np.random.default_rng(keys[k]), k >= trajectories) for k in range(first, len(keys))]
    try:
        check_vehicles(robot, conditions)
    except NoBatch:
        yield from ([_recorded(robot, recipe, conditions)] for recipe in recipes)
        return
    for k in range(0, len(recipes), AT_ONCE):
        yield _recorded_at_once(robot, recipes[k : k + AT_ONCE], conditions)


def _recorded(robot: RobotWithTask, recipe: _Recipe, conditions: Conditions) -> Trajectory:
    vehicle = vehicle_in_empty_arena(robot, recipe.rng, conditions)
    built = TrajectoryBuilder(vehicle.measured)
    for u in itertools.islice(recipe.inputs(robot), recipe.periods):
        period = vehicle.step(u)
        recipe.check(period.collision)
        built.add(vehicle.input, period.measured, period.subsamples, period.turned)
    return built.trajectory()


def _recorded_at_once(robot: RobotWithTask, recipes: Sequence[_Recipe], conditions: Conditions) -> list[Trajectory]:
    """Record many trajectories at once."""
    from brakeline.sim.batch.batch_env import vehicle_batch
    from brakeline.sim.batch.normal_streams import NormalStreams

    streams = NormalStreams(len(recipes), ahead=False)  # each generator draws the inputs as well
    for row, recipe in enumerate(recipes):
        streams.begin(row, recipe.rng)
    kind = robot.task.arenas[robot.task.default_arena]
    with closing(vehicle_batch(robot, len(recipes), kind, conditions, THREADS, streams)) as robots:
        arenas = [empty_arena_at_random(robot, recipe.rng) for recipe in recipes]
        robots.begin(np.arange(len(recipes)), arenas, [recipe.rng for recipe in recipes])
        built = [TrajectoryBuilder(state.copy()) for state in robots.measured]
        inputs = [recipe.inputs(robot) for recipe in recipes]
        for k in range(max(recipe.periods for recipe in recipes)):
            rows = np.array([row for row, recipe in enumerate(recipes) if k < recipe.periods])
            robots.set_input(rows, np.array([next(inputs[row]) for row in rows.tolist()]))
            period = robots.finish(rows, robots.advance(rows))
            for i, row in enumerate(rows.tolist()):
                recipes[row].check(bool(period.collision[i]))
                executed = robots.input[row].copy()
                built[row].add(executed, period.measured[i], period.subsamples[i], float(period.turned[i]))
    return [one.trajectory() for one in built]


def dataset(
    robot: RobotWithTask, trajectories: list[Trajectory], seed: int, conditions: Conditions, restless: int = 0
) -> Dataset:
    """Return the trajectories as a checked data set, with its origin in `about`."""
    data = Dataset(robot, tuple(trajectories), origin(robot, seed, conditions, restless))
    data.check()
    return data

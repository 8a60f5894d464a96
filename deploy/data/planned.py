"""`brakeline excite`: excitation that stays within a region, by what the inputs would do to a robot without lag."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from deploy.data.excite import excitation
from deploy.data.sources.quantities import columns_of, quantities
from messaging.robots import Array, Robot
from safety.dataset import BadData

RUN = 60.0  # s: then the robot is put back to the middle, for what was reckoned here drifts away from where it is
TRIES = 400  # excitations that are looked at for one that stays inside
LEAD = 4  # periods, at least, that one is made of


@dataclass(frozen=True)
class Row:
    time: float  # s, anew in each run
    run: int
    input: Array


def rows(robot: Robot, keep: tuple[float, float, float, float], minutes: float, seed: int) -> Iterator[Row]:
    """Inputs to give a robot, one a period; each run begins at rest in the region's middle, heading along x.

    Raises:
        BadData: the region has no room for the robot, or nobody can tell from its inputs where it goes.
    """
    low, high = np.array(keep[:2]) + robot.footprint, np.array(keep[2:]) - robot.footprint
    if not (low < high).all():
        raise BadData(f"the region {keep} has no room for a robot of {robot.footprint:g} m about its position")
    motion = _motion(robot)
    rng = np.random.default_rng(seed)
    length = round(RUN / robot.period)
    for run in range(max(math.ceil(60.0 * minutes / RUN), 1)):
        pose = np.array([*(low + high) / 2.0, 0.0])
        done: list[Array] = []
        while len(done) < length:
            inputs, pose = _stretch(robot, rng, motion, pose, low, high)
            done += inputs
        yield from (Row(k * robot.period, run, u) for k, u in enumerate(done))


def _stretch(
    robot: Robot, rng: np.random.Generator, motion: Array, pose: Array, low: Array, high: Array
) -> tuple[list[Array], Array]:
    """Inputs from rest to rest that stay inside, the first found, and the pose after them."""
    for _ in range(TRIES):
        inputs = _to_rest(robot, rng)
        after = pose
        for u in inputs:
            after = _moved(robot, motion, after, u)
            if not ((after[:2] >= low) & (after[:2] <= high)).all():
                break
        else:
            return inputs, after
    raise BadData("no excitation stays within the region: give it more room (--keep)")


def _to_rest(robot: Robot, rng: np.random.Generator) -> list[Array]:
    """One lead-in, plan and stop."""
    drawn = excitation(robot, rng)
    inputs = list(itertools.islice(drawn, LEAD))
    for u in drawn:
        inputs.append(u)
        if robot.rests(inputs[-1]) and robot.rests(inputs[-2]):
            return inputs
    raise AssertionError("excitation has no end")


def _motion(robot: Robot) -> Array:
    """(3, m): forward, left, turn (with a heading), or along x, along y, none, of each input."""
    usual, inputs = quantities(robot), columns_of(robot)[1]
    kinds = ("body.x", "body.y", "yaw rate") if robot.heading is not None else ("velocity.x", "velocity.y", "")
    motion = np.array([[usual.get(name) == f"command.{kind}" for name in inputs] for kind in kinds], float)
    if not motion[:2].any():
        raise BadData(f"{robot.name}: where it goes can't be told from {', '.join(robot.action)}: speeds are needed")
    return motion


def _moved(robot: Robot, motion: Array, pose: Array, u: Array) -> Array:
    forward, left, turn = motion @ u * robot.period
    heading = pose[2] + turn / 2.0
    cos, sin = math.cos(heading), math.sin(heading)
    step = np.array([cos * forward - sin * left, sin * forward + cos * left, turn])
    return np.asarray(pose + step)

"""Excitation that stays within a region (`brakeline excite`).

Printed inputs rely on dead reckoning of a robot without lag. A driven robot uses its measured position.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from brakeline.deploy.data.description_summary import nominal_stopping_distance
from brakeline.deploy.data.excitation import excitation
from brakeline.deploy.data.sources.quantity_names import column_names, quantities
from brakeline.errors import BadData
from brakeline.messaging.robot import Array, Robot
from brakeline.safety.filter.backup_plan import braking_plan

Region = tuple[float, float, float, float]  # x and y, least and most [m]

RUN = 60.0  # s per run; then the user puts the robot back to the middle, because dead reckoning drifts
TRIES = 400  # random manoeuvres to try for one that stays inside
LEAD = 4  # smallest number of periods of a manoeuvre


def excitation_rows(robot: Robot, keep: Region, minutes: float, seed: int) -> Iterator[tuple[float, int, Array]]:
    """Yield the time since the start of the run [s], the run and the input of each period.

    Each run begins at rest in the middle of the region, with the heading along x.

    Raises:
        BadData: the region is too small for the robot, or its inputs do not determine its motion.
    """
    bounded = _BoundedExcitation(robot, keep, np.random.default_rng(seed))
    if robot.heading is not None and not bounded.motion[2].any():
        raise BadData(f"{robot.name}: the inputs {', '.join(robot.action)} do not determine how it turns: use --drive")
    for run in range(max(math.ceil(60.0 * minutes / RUN), 1)):
        pose = np.array([*(bounded.low + bounded.high) / 2.0, 0.0])
        done: list[Array] = []
        while len(done) < run_length(robot):
            before = done[-1] if done else robot.zero_input()
            inputs, pose = bounded.draw(pose, bounded.low, bounded.high, before)
            done += inputs
        yield from ((k * robot.period, run, u) for k, u in enumerate(done))


def run_length(robot: Robot) -> int:
    """Return the number of periods per run."""
    return round(RUN / robot.period)


class RegionExcitation:
    """Excitation as a policy `(observation, info) -> input` that uses the measured position.

    Each manoeuvre goes from rest to rest. A robot that moves outwards within a stopping distance of the edge brakes
    and then begins a new manoeuvre.
    """

    def __init__(self, robot: Robot, keep: Region, rng: np.random.Generator) -> None:
        """Check the region.

        Raises:
            BadData: the region is too small to drive and stop, or the inputs do not determine the robot's motion.
        """
        self._robot, self._bounded = robot, _BoundedExcitation(robot, keep, rng)
        top = np.abs(self._bounded.motion[:2]) @ np.maximum(np.abs(robot.low()), robot.high())
        delayed = float(np.linalg.norm(top)) * robot.period  # way in one period of delay
        to_stop = (nominal_stopping_distance(robot) or 0.0) + delayed
        self._low, self._high = self._bounded.low + to_stop, self._bounded.high - to_stop
        if not (self._low < self._high).all():
            raise BadData(f"the region {keep} is too small to stop in: a stop takes about {to_stop:.2f} m on each side")
        self._left: list[Array] = []
        self._out = 0.0

    def __call__(self, observation: NDArray[np.float32], info: dict[str, Any]) -> Array:
        state, before = info["state"], info["input_in_force"]
        if info["time"] == 0.0:
            self._left, self._out = [], 0.0
        last, self._out = self._out, float(np.maximum(self._low - state[:2], state[:2] - self._high).max())
        if self._out > max(last, 0.0) and not self._robot.is_stop_input(before):
            self._left = list(braking_plan(self._robot, before)[1:])
        if not self._left:
            heading = 0.0 if self._robot.heading is None else state[self._robot.heading]
            # Near the edge the robot must not go farther out: it could not stop in time.
            low, high = np.minimum(self._low, state[:2]), np.maximum(self._high, state[:2])
            self._left = self._bounded.draw(np.array([*state[:2], heading]), low, high, before)[0]
        return self._left.pop(0)


class _BoundedExcitation:
    """Manoeuvres that stay within bounds by dead reckoning.

    low, high: smallest and largest position (2,) in m within the region; motion (3, m): maps inputs to speeds forward,
    left and around, or without a heading to x, y and zero.
    """

    def __init__(self, robot: Robot, keep: Region, rng: np.random.Generator) -> None:
        self._robot, self._rng = robot, rng
        usual, inputs = quantities(robot), column_names(robot)[1]
        kinds = ("body.x", "body.y", "yaw rate") if robot.heading is not None else ("velocity.x", "velocity.y", "")
        self.motion = np.array([[usual.get(name) == f"command.{kind}" for name in inputs] for kind in kinds], float)
        if not self.motion[:2].any():
            raise BadData(
                f"{robot.name}: the inputs {', '.join(robot.action)} do not determine its motion: they must be speeds"
            )
        self.low, self.high = np.array(keep[:2]) + robot.footprint, np.array(keep[2:]) - robot.footprint
        if not (self.low < self.high).all():
            raise BadData(
                f"the region {keep} is too small for a robot with a radius of {robot.footprint:g} m: enlarge it with "
                "--keep"
            )

    def draw(self, pose: Array, low: Array, high: Array, before: Array) -> tuple[list[Array], Array]:
        """Draw inputs from rest to rest that stay between `low` and `high`, and return the pose (3,) after them.

        before (m,): the input in force; a stop may hold some of its coordinates.
        """
        for _ in range(TRIES):
            inputs, after = self._to_rest(before), pose
            for u in inputs:
                after = self._moved(after, u)
                if not ((after[:2] >= low) & (after[:2] <= high)).all():
                    break
            else:
                return inputs, after
        raise BadData("no excitation stays within the region: enlarge it with --keep")

    def _to_rest(self, before: Array) -> list[Array]:
        """Return one lead-in, plan and stop."""
        inputs: list[Array] = []
        for u in excitation(self._robot, self._rng, before=before):
            inputs.append(u)
            if len(inputs) > LEAD and self._robot.is_stop_input(np.array(inputs[-2:])).all():
                break
        return inputs

    def _moved(self, pose: Array, u: Array) -> Array:
        """Return the pose (3,) after one period of dead reckoning."""
        forward, left, turn = self.motion @ u * self._robot.period
        heading = pose[2] + turn / 2.0
        cos, sin = math.cos(heading), math.sin(heading)
        return np.asarray(pose + np.array([cos * forward - sin * left, sin * forward + cos * left, turn]))

"""Scripted policies of both robots, by name; those of the ground robot (`brakeline.sim.quadrotor_policies` has the
quadrotor's).

They are there to collect data, to test a safety filter, and to show what an arena allows.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from brakeline.messaging.robot import Robot
from brakeline.messaging.task import RobotWithTask
from brakeline.sim.arena import Arena
from brakeline.sim.grid_planner import Routes
from brakeline.sim.ground_estimator import wrap
from brakeline.sim.quadrotor_policies import way_to_nearest
from brakeline.sim.reciprocal_avoidance import ReciprocalAvoidance

Array = NDArray[np.float64]
Policy = Callable[[NDArray[np.float32], dict[str, Any]], Array]  # (observation, info) -> action in physical units


class UnknownPolicy(ValueError):
    """No scripted policy has that name."""


def scripted(name: str, robot: RobotWithTask, rng: np.random.Generator) -> Policy:
    """The scripted policy of that name (`task.policies`). It notices new episodes itself.

    Raises:
        UnknownPolicy: with the names there are, or because the robot has none.
    """
    task = robot.task
    if name not in task.policies:
        there = ", ".join(task.policies) or "none"
        raise UnknownPolicy(f"no policy of the {robot.kind} is called {name!r}; there are: {there}")
    policy: Policy = task.code(task.policies[name])(robot, rng)
    return policy


def bearing(state: Array, target: Array | tuple[float, float]) -> float:
    """Angle from the robot's heading to a point, rad in [-π, π)."""
    return wrap(math.atan2(target[1] - state[1], target[0] - state[0]) - float(state[2]))


def bounded(robot: Robot, speed: float, turn_rate: float) -> Array:
    """The input (speed [m/s], turn rate [rad/s]) within the robot's bounds."""
    return np.asarray(np.clip((speed, turn_rate), robot.low(), robot.high()))


class RandomPolicy:
    """Inputs drawn evenly from the bounds, each held for 1 to `LONGEST` periods."""

    LONGEST = 10

    def __init__(self, robot: Robot, rng: np.random.Generator) -> None:
        self._robot, self._rng = robot, rng
        self._left = 0

    def __call__(self, observation: NDArray[np.float32], info: dict[str, Any]) -> Array:
        if info["time"] == 0.0 or self._left == 0:
            self._left = int(self._rng.integers(1, self.LONGEST, endpoint=True))
            self._input = self._rng.uniform(self._robot.low(), self._robot.high())
        self._left -= 1
        return self._input


class GroundGreedyPolicy:
    """Full speed, turning towards the goal on the way, whatever stands there."""

    def __init__(self, robot: Robot, rng: np.random.Generator) -> None:
        self._robot = robot

    def __call__(self, observation: NDArray[np.float32], info: dict[str, Any]) -> Array:
        wanted = bearing(info["state"], info["goal"]) / self._robot.period
        return bounded(self._robot, self._robot.high()[0], wanted)


class GroundAdversary:
    """Turns to the nearest obstacle on the spot, be it one that moves or a robot, then drives at it at full speed."""

    AIMED = 0.5  # rad; a larger bearing is turned off first, else it could circle the obstacle for ever

    def __init__(self, robot: Robot, rng: np.random.Generator) -> None:
        self._robot = robot

    def __call__(self, observation: NDArray[np.float32], info: dict[str, Any]) -> Array:
        nearest = way_to_nearest(info)
        angle = bearing(info["state"], info["state"][:2] + nearest)
        speed = self._robot.high()[0] if abs(angle) < self.AIMED else 0.0
        return bounded(self._robot, speed, angle / self._robot.period)


class GroundRoutePolicy:
    """Knows the map: follows the best way of `Routes` by pure pursuit of a point ahead that can be driven at straight.

    The larger the bearing of that point, the slower it drives; a point far to the side is turned to on the spot.
    Leaving the way needs no new search: `Routes` has one from every cell. Where other robots drive, it gets past them
    as `ReciprocalAvoidance` says.
    """

    COMFORT = 0.25  # m beside the footprint: more clearance than this is worth no detour
    AHEAD = 1.0  # m of the way that are looked at
    SPACING = 0.03  # m between the points at which a straight line is checked
    GIVE = 0.01  # m of clearance that a straight line may lose against the way it cuts short
    GAIN = 1.5  # 1/s, turn rate per bearing
    ALIGNED = 0.35  # rad; at larger bearings it turns on the spot

    def __init__(self, robot: Robot, rng: np.random.Generator) -> None:
        self._robot, self._rng = robot, rng
        self._arena: Arena | None = None

    def __call__(self, observation: NDArray[np.float32], info: dict[str, Any]) -> Array:
        if info["arena"] is not self._arena:
            self._arena = info["arena"]
            self._passing = ReciprocalAvoidance(self._robot, info["arena"].clearance_map, self._rng)
            self._routes = Routes(
                info["arena"].clearance_map, info["goal"], self._robot.footprint, self._robot.footprint + self.COMFORT
            )
        target = self._target(info["state"][:2])
        if len(others := info.get("others", ())):
            way = self._passing.direction(info["state"], target, others)
            return self._pursue(wrap(way - float(info["state"][2])))
        return self._pursue(bearing(info["state"], target))

    def _target(self, position: Array) -> Array:
        """The farthest point of the way ahead that a straight line reaches with (nearly) the way's own clearance."""
        way = self._routes.way(position, self.AHEAD)
        grid = self._routes.grid
        comfort = self._robot.footprint + self.COMFORT
        least = np.minimum.accumulate(np.minimum(grid.at(way), comfort)) - self.GIVE
        for i in range(len(way) - 1, 1, -1):
            steps = max(2, math.ceil(float(np.linalg.norm(way[i] - position)) / self.SPACING))
            line = position + np.linspace(0.0, 1.0, steps)[:, None] * (way[i] - position)
            if grid.at(line).min() >= least[i]:
                return np.asarray(way[i])
        return np.asarray(way[min(1, len(way) - 1)])

    def _pursue(self, angle: float) -> Array:
        """The input that turns to a bearing (rad) as fast as is smooth, and drives when roughly aligned."""
        speed = self._robot.high()[0] * max(0.0, 1.0 - abs(angle) / self.ALIGNED)
        return bounded(self._robot, speed, self.GAIN * angle)


class GroundCarefulPolicy(GroundRoutePolicy):
    """The same, that keeps a wide berth: where whatever is seen may move, what is near lets nobody pass."""

    COMFORT = 0.6

"""Scripted policies by name, and those of the ground robot; `brakeline.sim.quadrotor_policies` has the quadrotor's.

They collect data, test the safety filter, and show how well a robot can do in an arena.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from brakeline.errors import UnknownName
from brakeline.messaging.obstacle import Array, Shapes
from brakeline.messaging.robot import Robot
from brakeline.messaging.task import RobotWithTask
from brakeline.sim.arena import Arena
from brakeline.sim.grid_planner import Routes
from brakeline.sim.ground_estimator import wrap
from brakeline.sim.reciprocal_avoidance import ReciprocalAvoidance

Observation = NDArray[np.float32]
Policy = Callable[[Observation, dict[str, Any]], Array]  # (observation, info) -> input in physical units


def scripted(name: str, robot: RobotWithTask, rng: np.random.Generator) -> Policy:
    """Return the scripted policy of a name in `task.policies`. It notices by itself that a new episode starts.

    Raises:
        UnknownName: the robot has no policy of this name.
    """
    task = robot.task
    if name not in task.policies:
        names = ", ".join(task.policies) or "none"
        raise UnknownName(f"no policy of the {robot.kind} is called {name!r}; there are: {names}")
    policy: Policy = task.code(task.policies[name])(robot, rng)
    return policy


def bearing(state: Array, target: Array | tuple[float, float]) -> float:
    """Return the angle from the robot's heading to a point, rad in [-π, π)."""
    return wrap(math.atan2(target[1] - state[1], target[0] - state[0]) - float(state[2]))


def bounded(robot: Robot, speed: float, turn_rate: float) -> Array:
    """Return the input (speed [m/s], turn rate [rad/s]) within the robot's bounds."""
    return np.asarray(np.clip((speed, turn_rate), robot.low(), robot.high()))


def vector_to_nearest(info: dict[str, Any]) -> Array:
    """Return the vector (d,) [m] from the measured position to the nearest obstacle, moving or not, or robot."""
    arena: Arena = info["arena"]
    position = info["state"][: arena.dim]
    vectors = arena.shapes.towards(position)
    if moving := [obstacle for obstacle in info["obstacles"] if obstacle.motion is not None]:
        vectors = np.concatenate([vectors, Shapes.at_present(moving, arena.dim).towards(position)])
    if len(others := info.get("others", ())):
        vectors = np.concatenate([vectors, others[:, : arena.dim] - position])
    return np.asarray(vectors[np.argmin(np.einsum("ni,ni->n", vectors, vectors))])


class ScriptedPolicy:
    """The base of policies that need the robot and a generator."""

    def __init__(self, robot: Robot, rng: np.random.Generator) -> None:
        self._robot, self._rng = robot, rng


class RandomPolicy(ScriptedPolicy):
    """Draws inputs uniformly from the bounds, and repeats each for 1 to `LONGEST` periods."""

    LONGEST = 10
    _periods_left = 0

    def __call__(self, observation: Observation, info: dict[str, Any]) -> Array:
        if info["time"] == 0.0 or self._periods_left == 0:
            self._periods_left = int(self._rng.integers(1, self.LONGEST, endpoint=True))
            self._input = self._rng.uniform(self._robot.low(), self._robot.high())
        self._periods_left -= 1
        return self._input


class GroundGreedyPolicy(ScriptedPolicy):
    """Drives at full speed, turning towards the goal, whatever stands in between."""

    def __call__(self, observation: Observation, info: dict[str, Any]) -> Array:
        turn_rate = bearing(info["state"], info["goal"]) / self._robot.period
        return bounded(self._robot, self._robot.high()[0], turn_rate)


class GroundAdversary(ScriptedPolicy):
    """Turns on the spot towards the nearest obstacle, moving or not, or robot, then drives at it at full speed."""

    AIMED = 0.5  # rad; at a larger bearing it only turns, else it could circle the obstacle for ever

    def __call__(self, observation: Observation, info: dict[str, Any]) -> Array:
        angle = bearing(info["state"], info["state"][:2] + vector_to_nearest(info))
        speed = self._robot.high()[0] if abs(angle) < self.AIMED else 0.0
        return bounded(self._robot, speed, angle / self._robot.period)


class GroundRoutePolicy(ScriptedPolicy):
    """Follows the best path on the map (`Routes`) by pure pursuit of the farthest point in a straight line.

    The larger the bearing of that point, the slower it drives; it turns on the spot towards a point far to the side.
    It needs no new search after leaving its path: `Routes` has a path from every cell. Other robots it avoids by
    `ReciprocalAvoidance`.
    """

    WANTED_GAP = 0.25  # m beside the footprint; more clearance than this is worth no detour
    LOOKAHEAD = 1.0  # m of the path
    SPACING = 0.03  # m between the points at which it checks a straight line
    CLEARANCE_LOSS = 0.01  # m of clearance that a straight line may lose against the path that it cuts short
    GAIN = 1.5  # 1/s, turn rate per bearing
    ALIGNED = 0.35  # rad; at larger bearings it turns on the spot

    _arena: Arena | None = None

    def __call__(self, observation: Observation, info: dict[str, Any]) -> Array:
        if info["arena"] is not self._arena:
            self._arena = info["arena"]
            grid, footprint = info["arena"].clearance_map, self._robot.footprint
            self._avoidance = ReciprocalAvoidance(self._robot, grid, self._rng)
            self._routes = Routes(grid, info["goal"], footprint, footprint + self.WANTED_GAP)
        target = self._target(info["state"][:2])
        if len(others := info.get("others", ())):
            direction = self._avoidance.direction(info["state"], target, others)
            return self._pursue(wrap(direction - float(info["state"][2])))
        return self._pursue(bearing(info["state"], target))

    def _target(self, position: Array) -> Array:
        """Return the farthest point of the path that a straight line reaches with nearly the path's own clearance."""
        path = self._routes.path(position, self.LOOKAHEAD)
        grid = self._routes.grid
        wanted = self._robot.footprint + self.WANTED_GAP
        least = np.minimum.accumulate(np.minimum(grid.at(path), wanted)) - self.CLEARANCE_LOSS
        for i in range(len(path) - 1, 1, -1):
            steps = max(2, math.ceil(float(np.linalg.norm(path[i] - position)) / self.SPACING))
            line = position + np.linspace(0.0, 1.0, steps)[:, None] * (path[i] - position)
            if grid.at(line).min() >= least[i]:
                return np.asarray(path[i])
        return np.asarray(path[min(1, len(path) - 1)])

    def _pursue(self, angle: float) -> Array:
        """Return the input that turns towards a bearing [rad], and drives when roughly aligned."""
        speed = self._robot.high()[0] * max(0.0, 1.0 - abs(angle) / self.ALIGNED)
        return bounded(self._robot, speed, self.GAIN * angle)


class GroundCarefulPolicy(GroundRoutePolicy):
    """Keeps a larger distance: if free space comes from scans, obstacles close to the path block it."""

    WANTED_GAP = 0.6

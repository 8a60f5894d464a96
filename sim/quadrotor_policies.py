"""Scripted policies of the quadrotor: straight at the goal, straight at an obstacle, and along paths on the map."""

from __future__ import annotations

import math
from itertools import product
from typing import Any

import numpy as np

from brakeline.messaging.obstacle import Array
from brakeline.messaging.robot import Robot
from brakeline.sim.arena import Arena
from brakeline.sim.grid_planner import Routes
from brakeline.sim.scripted_policies import Observation, ScriptedPolicy, vector_to_nearest


def full_speed(robot: Robot, direction: Array) -> Array:
    """Return the fastest setpoint within the robot's bounds in a direction (3,); zero for the zero vector."""
    largest = float(np.abs(direction).max())
    return robot.high() * direction / largest if largest > 0.0 else np.zeros_like(direction)


class QuadrotorGreedyPolicy(ScriptedPolicy):
    """Flies at full speed straight at the goal, whatever stands in between."""

    def __call__(self, observation: Observation, info: dict[str, Any]) -> Array:
        return full_speed(self._robot, np.asarray(info["goal"]) - info["state"][:3])


class QuadrotorAdversary(ScriptedPolicy):
    """Flies at full speed straight at the nearest obstacle, moving or not, floor and ceiling included."""

    def __call__(self, observation: Observation, info: dict[str, Any]) -> Array:
        return full_speed(self._robot, vector_to_nearest(info))


class StopPrediction:
    """Predicts a setpoint and the stop after it: the vehicle's velocity follows setpoints with a first-order lag.

    The setpoint u holds for a period, then falls to zero as at the end of the robot's plans. Positions are linear in
    the velocity v at the start and in u: p + `from_velocity`·v + `from_setpoint`·u, at `times` (K,) [s].
    """

    LAG = 0.35  # s, fitted to the quadrotor, whose lag is a cascade of shorter ones
    POINTS = 2  # in a period

    def __init__(self, robot: Robot) -> None:
        self._period = robot.period
        fine = 20  # integration steps for each point
        step = robot.period / (self.POINTS * fine)
        fractions = robot.stop_profile()[: robot.horizon - robot.committed_steps, 0]  # of u, in each period
        velocity, offset = np.array([1.0, 0.0]), np.zeros(2)  # coefficients of v and u
        offsets: list[Array] = []
        for fraction in np.repeat(fractions, self.POINTS * fine):
            velocity = velocity + (step / self.LAG) * (np.array([0.0, fraction]) - velocity)
            offset = offset + step * velocity
            offsets.append(offset)
        self.from_velocity, self.from_setpoint = np.array(offsets[fine - 1 :: fine]).T
        self.times: Array = np.cumsum(np.full(len(offsets) // fine, robot.period / self.POINTS))

    def after(self, position: Array, velocity: Array, setpoint: Array) -> tuple[Array, Array]:
        """Return position and velocity (3,) after a period at a setpoint (3,)."""
        lost = 1.0 - math.exp(-self._period / self.LAG)
        slip = velocity - setpoint
        return position + self._period * setpoint + self.LAG * lost * slip, velocity - lost * slip

    def __call__(self, position: Array, velocity: Array, setpoints: Array) -> Array:
        """Return the positions (C, K, 3) after each of the setpoints (C, 3), from a position (3,) and velocity (3,)."""
        coasting = position + self.from_velocity[:, None] * velocity
        return np.asarray(coasting + self.from_setpoint[:, None] * setpoints[:, None])


class QuadrotorRoutePolicy(ScriptedPolicy):
    """Knows the map: it takes the reachable setpoint whose stop leads farthest along the path to the goal.

    At every step it predicts the stops after a grid of setpoints. It considers those that keep `MARGIN` from every
    obstacle, and the distance of `MARGIN_TIME` seconds more: a filter that only knows half-spaces between the robot
    and the obstacles can verify them too. So it flies as fast as the free space ahead allows, and slows down in bends.
    """

    WANTED_CLEARANCE = 2.0  # m; more clearance than this is worth no detour
    MARGIN = 0.6  # m beside the footprint: the width of the tube around the stop, and the clearance margin
    MARGIN_TIME = 0.1  # s
    PREFERRED_GAP = 0.0  # m beside the footprint; a smaller gap has a price
    PREFERRED_GAP_TIME = 0.0  # s, as `MARGIN_TIME`
    GAP_PRICE = 0.5  # m of path per metre that is missing to the preferred gap, at each point of a stop
    TIME_PRICE = 1.0  # m of path per second
    SLEW_SHARES = (-1.0, -0.5, 0.0, 0.5, 1.0)  # the grid of setpoints, on each axis

    def __init__(self, robot: Robot, rng: np.random.Generator) -> None:
        super().__init__(robot, rng)
        self._stops = StopPrediction(robot)
        self._prepared: dict[int, tuple[Arena, Routes]] = {}
        self._changes = np.array(list(product(self.SLEW_SHARES, repeat=robot.action_dim))) * robot.action_slew
        self._arena: Arena | None = None

    def __call__(self, observation: Observation, info: dict[str, Any]) -> Array:
        if info["arena"] is not self._arena:
            self._arena = info["arena"]
            self._grid = info["arena"].clearance_map
            _, self._routes = self._prepared.get(id(self._arena)) or (self._arena, self._plan(info["arena"]))
        state = info["state"]
        low, high = self._robot.low(), self._robot.high()
        setpoints = np.clip(info["input_in_force"] + self._changes, low, high)
        position, velocity = state[:3], state[3:6]
        if self._robot.late:  # this setpoint takes effect after the present period
            position, velocity = self._stops.after(position, velocity, info["input_in_force"])
        positions = self._stops(position, velocity, setpoints)
        cost_to_go = self._routes.cost_to_go(positions)
        at_goal = np.linalg.norm(positions - info["goal"], axis=-1) < info["arena"].goal_radius
        cost = (np.where(at_goal, 0.0, cost_to_go) + self.TIME_PRICE * self._stops.times).min(axis=1)
        speed, clearance = self._speed(positions, position), self._clearance(positions)
        cost += self.GAP_PRICE * _missing(self.PREFERRED_GAP + self.PREFERRED_GAP_TIME * speed, clearance)
        lack = _missing(self.MARGIN + self.MARGIN_TIME * speed, clearance)
        free = lack == 0.0
        best = np.argmin(np.where(free, cost, np.inf) if free.any() else lack)
        return np.asarray(setpoints[best])

    def prepare(self, arena: Arena) -> None:
        """Plan the paths in an arena in advance: it takes longer than a period, too long during a real flight."""
        self._prepared[id(arena)] = (arena, self._plan(arena))

    def _plan(self, arena: Arena) -> Routes:
        return Routes(arena.clearance_map, arena.goal, self._robot.footprint, self.WANTED_CLEARANCE)

    def _speed(self, stops: Array, position: Array) -> Array:
        """Return the speed (C, K) [m/s] at the points of each stop (C, K, 3) from a position (3,)."""
        before = np.concatenate((np.broadcast_to(position, (len(stops), 1, 3)), stops[:, :-1]), axis=1)
        return np.asarray(np.linalg.norm(stops - before, axis=-1) / self._stops.times[0])

    def _clearance(self, points: Array) -> Array:
        """Return the clearance (C, K) [m] of the footprint at points (C, K, 3)."""
        return np.asarray(self._grid.interpolate(self._grid.clearance, points) - self._robot.footprint)


class QuadrotorCarefulPolicy(QuadrotorRoutePolicy):
    """Keeps a larger distance: if free space comes from scans, obstacles seem larger, and corners hide others."""

    WANTED_CLEARANCE = 3.0
    PREFERRED_GAP = 1.0
    PREFERRED_GAP_TIME = 0.4


def _missing(wanted: Array, clearance: Array) -> Array:
    """Return the clearance that is missing to the wanted one, summed over each stop (C, K) [m]: (C,)."""
    return np.asarray(np.maximum(wanted - clearance, 0.0).sum(axis=1))

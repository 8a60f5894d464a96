"""Scripted policies of the quadrotor: straight at the goal, straight at an obstacle, and along routes over the map."""

from __future__ import annotations

import math
from itertools import product
from typing import Any

import numpy as np
from numpy.typing import NDArray

from brakeline.messaging.obstacle import Shapes
from brakeline.messaging.robot import Robot
from brakeline.sim.arena import Arena
from brakeline.sim.grid_planner import Routes

Array = NDArray[np.float64]


def full_speed(robot: Robot, direction: Array) -> Array:
    """The fastest setpoint within the robot's bounds in a direction (3,); zero when there is none."""
    largest = float(np.abs(direction).max())
    return robot.high() * direction / largest if largest > 0.0 else np.zeros_like(direction)


def way_to_nearest(info: dict[str, Any]) -> Array:
    """From the measured position to the closest point of anything, what moves included, (d,) m."""
    arena: Arena = info["arena"]
    position = info["state"][: arena.dim]
    ways = arena.shapes.towards(position)
    if moving := [obstacle for obstacle in info["obstacles"] if obstacle.motion is not None]:
        ways = np.concatenate([ways, Shapes.of(moving, arena.dim).towards(position)])
    if len(others := info.get("others", ())):
        ways = np.concatenate([ways, others[:, : arena.dim] - position])
    return np.asarray(ways[np.argmin(np.einsum("ni,ni->n", ways, ways))])


class QuadrotorGreedyPolicy:
    """Full speed straight at the goal, whatever stands there."""

    def __init__(self, robot: Robot, rng: np.random.Generator) -> None:
        self._robot = robot

    def __call__(self, observation: NDArray[np.float32], info: dict[str, Any]) -> Array:
        return full_speed(self._robot, np.asarray(info["goal"]) - info["state"][:3])


class QuadrotorAdversary:
    """Full speed straight at the nearest obstacle, floor and ceiling and what moves included."""

    def __init__(self, robot: Robot, rng: np.random.Generator) -> None:
        self._robot = robot

    def __call__(self, observation: NDArray[np.float32], info: dict[str, Any]) -> Array:
        return full_speed(self._robot, way_to_nearest(info))


class StopPrediction:
    """Where a setpoint and the stop after it lead: the vehicle's velocity follows setpoints with a first-order lag.

    The setpoint u holds for a period, then falls to zero as the robot's plans do. Positions are linear in the velocity
    at the start and u: p + `from_velocity`·v + `from_setpoint`·u, at `times` (K,) s.
    """

    LAG = 0.35  # s, fitted to the quadrotor: a cascade of shorter ones
    POINTS = 2  # a period

    def __init__(self, robot: Robot) -> None:
        self._period = robot.period
        fine = 20  # steps of the integration a point
        step = robot.period / (self.POINTS * fine)
        fractions = robot.plan_matrix()[
            robot.committed_steps * robot.action_dim :: robot.action_dim, -robot.action_dim
        ]  # of u
        velocity, way = np.array([1.0, 0.0]), np.zeros(2)  # the shares of v and of u in them
        ways: list[Array] = []
        for fraction in np.repeat(fractions, self.POINTS * fine):
            velocity = velocity + (step / self.LAG) * (np.array([0.0, fraction]) - velocity)
            way = way + step * velocity
            ways.append(way)
        self.from_velocity, self.from_setpoint = np.array(ways[fine - 1 :: fine]).T
        self.times: Array = np.cumsum(np.full(len(ways) // fine, robot.period / self.POINTS))

    def after(self, position: Array, velocity: Array, setpoint: Array) -> tuple[Array, Array]:
        """Position and velocity (3,) after a period at a setpoint (3,)."""
        lost = 1.0 - math.exp(-self._period / self.LAG)
        slip = velocity - setpoint
        return position + self._period * setpoint + self.LAG * lost * slip, velocity - lost * slip

    def __call__(self, position: Array, velocity: Array, setpoints: Array) -> Array:
        """Positions (C, K, 3) from a state's position (3,) and velocity (3,) after each of the setpoints (C, 3)."""
        coasting = position + self.from_velocity[:, None] * velocity
        return np.asarray(coasting + self.from_setpoint[:, None] * setpoints[:, None])


class QuadrotorRoutePolicy:
    """Knows the map: of the setpoints within reach takes the one whose stop leads farthest along the routes to the
    goal.

    At every step the stops after a grid of setpoints are predicted. Those count that keep `MARGIN` from every obstacle,
    and `CARE` seconds' way more while they are fast: whoever sees only half-spaces between the robot and the obstacles
    can verify them too. So it is as fast as the room ahead allows, and slows down where a way bends.
    """

    COMFORT = 2.0  # m; more clearance than this is worth no detour
    MARGIN = 0.6  # m beside the footprint: what a tube about the stop takes, and comfort
    CARE = 0.1  # s
    BERTH = 0.0  # m beside the footprint that it would rather keep
    UNEASE = 0.0  # s, as `CARE`
    PRICE = 0.5  # m of the way that a metre missing to those is worth, at each point of a stop
    PACE = 1.0  # m/s; a second earlier at a place is worth this many metres of the way
    SHARES = (-1.0, -0.5, 0.0, 0.5, 1.0)  # of the slew, on each axis

    def __init__(self, robot: Robot, rng: np.random.Generator) -> None:
        self._robot = robot
        self._stops = StopPrediction(robot)
        self._prepared: dict[int, tuple[Arena, Routes]] = {}
        self._changes = np.array(list(product(self.SHARES, repeat=robot.action_dim))) * robot.action_slew
        self._arena: Arena | None = None

    def __call__(self, observation: NDArray[np.float32], info: dict[str, Any]) -> Array:
        if info["arena"] is not self._arena:
            self._arena = info["arena"]
            self._grid = info["arena"].clearance_map
            _, self._routes = self._prepared.get(id(self._arena)) or (self._arena, self._plan(info["arena"]))
        state = info["state"]
        low, high = self._robot.low(), self._robot.high()
        setpoints = np.clip(info["input_in_force"] + self._changes, low, high)
        position, velocity = state[:3], state[3:6]
        if self._robot.late:  # the setpoint is for the period after this one
            position, velocity = self._stops.after(position, velocity, info["input_in_force"])
        places = self._stops(position, velocity, setpoints)
        to_go = self._routes.to_go(places)
        at_goal = np.linalg.norm(places - info["goal"], axis=-1) < info["arena"].goal_radius
        value = (np.where(at_goal, 0.0, to_go) + self.PACE * self._stops.times).min(axis=1)
        speed, clearance = self._speed(places, position), self._clearance(places)
        value += self.PRICE * _missing(self.BERTH + self.UNEASE * speed, clearance)
        lack = _missing(self.MARGIN + self.CARE * speed, clearance)
        free = lack == 0.0
        best = np.argmin(np.where(free, value, np.inf) if free.any() else lack)
        return np.asarray(setpoints[best])

    def prepare(self, arena: Arena) -> None:
        """Find the ways in an arena now: it takes longer than a period, and in flight there is no time for it."""
        self._prepared[id(arena)] = (arena, self._plan(arena))

    def _plan(self, arena: Arena) -> Routes:
        return Routes(arena.clearance_map, arena.goal, self._robot.footprint, self.COMFORT)

    def _speed(self, places: Array, position: Array) -> Array:
        """How fast each stop (C, K, 3) from a position (3,) gets to its points, m/s: (C, K)."""
        before = np.concatenate((np.broadcast_to(position, (len(places), 1, 3)), places[:, :-1]), axis=1)
        return np.asarray(np.linalg.norm(places - before, axis=-1) / self._stops.times[0])

    def _clearance(self, places: Array) -> Array:
        """Of the footprint about points (C, K, 3), m: (C, K)."""
        return np.asarray(self._grid.between(self._grid.clearance, places) - self._robot.footprint)


class QuadrotorCarefulPolicy(QuadrotorRoutePolicy):
    """The same, that keeps a wide berth: by scans, obstacles seem larger, and nobody knows what a corner hides."""

    COMFORT = 3.0
    BERTH = 1.0
    UNEASE = 0.4


def _missing(wanted: Array, clearance: Array) -> Array:
    """What stops (C, K) miss to the clearance asked for, summed over each, m: (C,)."""
    return np.asarray(np.maximum(wanted - clearance, 0.0).sum(axis=1))

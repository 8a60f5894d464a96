"""An arena of ten cylinders, and two drivers in it: one that aims at obstacles, and a planner on a grid."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from drive import VEHICLES, Vehicle
from numpy.typing import NDArray

Array = NDArray[np.float64]

SIDE = 6.0  # m
CYLINDERS = 10
APART = 3.0  # m, at least, between start and goal
CELL, BEYOND = 0.1, 0.6  # m: edge of a cell; how far paths may lead out of the arena
AHEAD = 0.5  # m: a path is followed towards the point so far ahead on it
WHEELBASE = 0.3  # m, of the car
AT_GOAL = 0.3  # m
STUCK, AWAY = 2.5, 1.5  # s without motion, after which the planner backs off for so long
ASIDE = 1.2  # rad: a car does not turn towards a point farther aside; it backs off first
CAUTION = 0.1  # m to obstacles at which a cell costs about a third of the extra costs
EXTRA = 3.0  # extra costs of a cell that touches an obstacle, in cells


@dataclass(frozen=True)
class Arena:
    """Cylinders in a square, and where a robot starts and has to go."""

    # centers (10, 2), radii (10,): the cylinders [m]
    centers: Array
    radii: Array
    start: Array  # (3,): pose
    goal: Array  # (2,): position

    @staticmethod
    def random(generator: np.random.Generator, room: float) -> Arena:
        """Return a random arena. room [m]: distance of start and goal to all cylinders, and half that of a gap."""
        while True:
            centers = generator.uniform(-SIDE / 2, SIDE / 2, (CYLINDERS, 2))
            radii = generator.uniform(0.1, 0.3, CYLINDERS)
            start, goal = generator.uniform(-SIDE / 2, SIDE / 2, (2, 2))
            pose = np.array([*start, generator.uniform(-math.pi, math.pi)])
            arena = Arena(centers, radii, pose, goal)
            clear = min(arena.distance(start), arena.distance(goal)) > room
            if clear and np.linalg.norm(goal - start) > APART and np.isfinite(Planner(arena, room).costs_at(start)):
                return arena

    def distance(self, points: Array) -> float:
        """Return the smallest distance [m] of points (..., 2) to a cylinder."""
        gaps = np.linalg.norm(points[..., None, :] - self.centers, axis=-1) - self.radii
        return float(gaps.min())

    def clearance(self, vehicle: Vehicle, poses: Array) -> float:
        """Return the smallest distance [m] of a robot's body to a cylinder at true poses (T, 3); below 0: collision."""
        heading = np.stack([np.cos(poses[:, 2]), np.sin(poses[:, 2])], axis=1)
        return min(self.distance(poses[:, :2] + ahead * heading) - radius for ahead, radius in vehicle.body)


def _angle(value: float) -> float:
    return (value + math.pi) % (2.0 * math.pi) - math.pi


def towards(vehicle: Vehicle, state: Array, target: Array, speed: float, backwards: bool) -> Array:
    """Return the inputs (2,) that drive a robot in a measured state towards a point (2,).

    Args:
        vehicle: the robot.
        state (n,): measured.
        target (2,): point in the world.
        speed: wanted speed [m/s].
        backwards: drive backwards, if the point is behind and the robot can.
    """
    dx, dy = target - state[:2]
    bearing = _angle(math.atan2(dy, dx) - state[2])
    back = backwards and vehicle.low[0] < 0.0 and abs(bearing) > math.pi / 2
    if back:
        bearing, speed = _angle(bearing + math.pi), vehicle.low[0] * speed / vehicle.high[0]
    if vehicle is VEHICLES["car"]:
        curvature = 2.0 * math.sin(bearing) / max(math.hypot(dx, dy), AHEAD / 2)
        turn = math.atan(WHEELBASE * (curvature if abs(bearing) < math.pi / 2 else math.copysign(9.0, bearing)))
        turn = -turn if back else turn
    else:
        turn = 2.0 * bearing
        speed *= max(math.cos(bearing), 0.0) ** 2
    return np.clip([speed, turn], vehicle.low, vehicle.high)


class Adversary:
    """Drives at the nearest cylinder as fast as it can."""

    def __init__(self, vehicle: Vehicle, arena: Arena, backwards: bool) -> None:
        self.vehicle, self.arena, self.backwards = vehicle, arena, backwards

    def inputs(self, state: Array) -> Array:
        """Return the inputs (2,) in a measured state (n,)."""
        gaps = np.linalg.norm(self.arena.centers - state[:2], axis=1) - self.arena.radii
        target = self.arena.centers[int(gaps.argmin())]
        chosen = towards(self.vehicle, state, target, self.vehicle.high[0], self.backwards)
        if not self.backwards:
            chosen[0] = self.vehicle.high[0]
        return chosen


class Planner:
    """Follows the cheapest path on a grid to the goal, and backs off if it does not get on."""

    def __init__(self, arena: Arena, room: float) -> None:
        """Plan. room [m]: distance that a path keeps to all cylinders."""
        self.arena = arena
        self.edge = SIDE / 2 + BEYOND
        self.count = round(2.0 * self.edge / CELL) + 1
        axis = np.linspace(-self.edge, self.edge, self.count)
        points = np.stack(np.meshgrid(axis, axis, indexing="ij"), axis=-1)
        gaps = np.linalg.norm(points[:, :, None] - arena.centers, axis=-1) - arena.radii
        self._gap = gaps.min(-1) - room
        self._still, self._back, self._side, self._last = 0.0, 0.0, 1.0, np.full(3, 1e6)

    def _cell(self, point: Array) -> tuple[int, int]:
        i, j = np.clip(np.round((point + self.edge) / CELL).astype(int), 0, self.count - 1)
        return int(i), int(j)

    @cached_property
    def costs(self) -> Array:
        """The costs (count, count) from each cell to the goal; infinite where no path leads there."""
        weight = np.where(self._gap > 0.0, CELL * (1.0 + EXTRA * np.exp(-np.maximum(self._gap, 0.0) / CAUTION)), np.inf)
        costs, n = np.full(weight.shape, np.inf), self.count
        costs[self._cell(self.arena.goal)] = 0.0
        steps = [(i, j) for i in (0, 1, 2) for j in (0, 1, 2) if (i, j) != (1, 1)]
        while True:  # each round adds the paths with one more step
            around = np.pad(costs, 1, constant_values=np.inf)
            ways = [around[i : i + n, j : j + n] + weight * math.hypot(i - 1, j - 1) for i, j in steps]
            cheaper = np.minimum(costs, np.min(ways, axis=0))
            if np.array_equal(cheaper, costs):
                return costs
            costs = cheaper

    def _around(self, i: int, j: int) -> list[tuple[int, int]]:
        steps = ((a, b) for a in (i - 1, i, i + 1) for b in (j - 1, j, j + 1) if (a, b) != (i, j))
        return [(a, b) for a, b in steps if 0 <= a < self.count and 0 <= b < self.count]

    def costs_at(self, point: Array) -> float:
        """Return the costs from a point (2,) to the goal."""
        return float(self.costs[self._cell(point)])

    def _ahead(self, point: Array) -> Array:
        """Return the point (2,) that is `AHEAD` on the way from a point to the goal."""
        i, j = self._cell(point)
        for _ in range(round(AHEAD / CELL)):
            if not self.costs[i, j] > 0.0:
                return self.arena.goal
            i, j = min(self._around(i, j), key=lambda cell: self.costs[cell])
        return np.array([i, j]) * CELL - self.edge

    def inputs(self, vehicle: Vehicle, state: Array) -> Array:
        """Return the inputs (2,) in a measured state (n,)."""
        moved = abs(_angle(state[2] - self._last[2])) > 0.1 or math.dist(state[:2], self._last[:2]) > 0.05
        self._still = 0.0 if moved else self._still + vehicle.period
        self._last = state[:3].copy() if moved else self._last
        target = self._ahead(state[:2])
        bearing = _angle(math.atan2(target[1] - state[1], target[0] - state[0]) - state[2])
        car = vehicle is VEHICLES["car"]
        if self._back <= 0.0 and (self._still > STUCK or (car and abs(bearing) > ASIDE)):
            self._still, self._back = 0.0, AWAY
            self._side = math.copysign(1.0, -bearing if car else bearing)
        if self._back > 0.0:
            self._back -= vehicle.period
            return np.clip([-vehicle.high[0], self._side * vehicle.high[1]], vehicle.low, vehicle.high)
        left = float(np.linalg.norm(self.arena.goal - state[:2]))
        return towards(vehicle, state, target, vehicle.high[0] * min(1.0, 0.3 + left), backwards=False)

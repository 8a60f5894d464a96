"""Arenas: square rooms with obstacles, a start and a goal, drawn at random so that a way through exists."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from messaging.robots import Robot
from messaging.shapes import BOX, CYLINDER, WALL, Obstacle, Shapes
from sim.planner import ClearanceMap

Array = NDArray[np.float64]


class UnknownArena(ValueError):
    """The name is not in `ARENAS`."""


class NoArena(RuntimeError):
    """No draw of an arena kind had a way from start to goal: its numbers ask for too much."""


@dataclass(frozen=True)
class Arena:
    """One room, for one episode. Lengths in m, angles in rad, world frame."""

    name: str
    obstacles: tuple[Obstacle, ...]  # 2-D; the four walls come last
    start: tuple[float, float, float]  # x, y, heading
    goal: tuple[float, float]
    goal_radius: float
    step_limit: int  # periods until the episode is cut off
    bounds: tuple[float, float]  # lowest and highest coordinate inside the walls, the same for x and y

    @cached_property
    def shapes(self) -> Shapes:
        return Shapes.of(self.obstacles, dim=2)

    @cached_property
    def clearance_map(self) -> ClearanceMap:
        return ClearanceMap(self.obstacles, self.bounds)


@dataclass(frozen=True)
class ArenaKind:
    """What is drawn for an arena of one name. Pairs are (least, most)."""

    half_width: float  # m
    cylinders: tuple[int, int]
    radius: tuple[float, float]  # m
    boxes: tuple[int, int]
    edge: tuple[float, float]  # m, both edges of a box
    square: bool  # boxes have two equal edges
    gap: float  # m between any two obstacles, walls included, beyond the robot's diameter
    path_clearance: float  # m beside the footprint, all along some way from start to goal
    goal_distance: float  # m from the start, at least
    step_limit: int
    start_clearance: float = 0.1  # m beside the footprint, at the start and at the goal
    goal_radius: float = 0.25  # m


ARENAS: dict[str, ArenaKind] = {
    "default": ArenaKind(
        half_width=2.5,
        cylinders=(3, 5),
        radius=(0.1, 0.2),
        boxes=(3, 5),
        edge=(0.2, 0.4),
        square=False,
        gap=0.2,
        path_clearance=0.05,
        goal_distance=1.5,
        step_limit=300,
    ),
    "open": ArenaKind(
        half_width=8.2,
        cylinders=(0, 6),
        radius=(0.5, 0.5),
        boxes=(0, 6),
        edge=(1.0, 1.0),
        square=True,
        gap=0.3,
        path_clearance=0.05,
        goal_distance=3.0,
        # the diagonal is 23 m, 5 cm a step: twice the steps of a straight drive, nearly
        step_limit=800,
    ),
    "dense": ArenaKind(
        half_width=2.5,
        cylinders=(6, 8),
        radius=(0.1, 0.2),
        boxes=(6, 8),
        edge=(0.2, 0.4),
        square=False,
        gap=0.1,
        # a hair below half the gap: a grid cannot thread a passage that has no width to spare
        path_clearance=0.04,
        goal_distance=1.5,
        step_limit=300,
    ),
}

ATTEMPTS = 1000  # whole arenas drawn before giving up
CANDIDATES = 12  # drawn at once for each obstacle, of which the first that fits stays


def arena_kind(name: str) -> ArenaKind:
    """Raises UnknownArena with the names there are."""
    if name not in ARENAS:
        raise UnknownArena(f"no arena is called {name!r}; there are: {', '.join(sorted(ARENAS))}")
    return ARENAS[name]


def draw_arena(name: str, rng: np.random.Generator, robot: Robot) -> Arena:
    """An arena of that name in which `robot` can get from start to goal.

    Raises:
        UnknownArena: with the names there are.
        NoArena: when a kind's numbers leave no solvable arena.
    """
    kind = arena_kind(name)
    for _ in range(ATTEMPTS):
        obstacles = _place(kind, rng, robot)
        if obstacles is None:
            continue
        ends = _start_and_goal(kind, obstacles, rng, robot)
        if ends is None:
            continue
        start, goal = ends
        heading = float(rng.uniform(-math.pi, math.pi))
        bounds = (-kind.half_width, kind.half_width)
        arena = Arena(name, obstacles, (*start, heading), goal, kind.goal_radius, kind.step_limit, bounds)
        if arena.clearance_map.connected(start, goal, robot.footprint + kind.path_clearance):
            return arena
    raise NoArena(f"no arena {name!r} with a way from start to goal in {ATTEMPTS} draws")


def staged_arena(
    *obstacles: Obstacle,
    start: tuple[float, float, float] = (0.0, 0.0, 0.0),
    goal: tuple[float, float] = (4.0, 4.0),
    half_width: float = 5.0,
) -> Arena:
    """A walled room about the origin with these obstacles and nothing left to chance, for tests and trials."""
    return Arena("staged", (*obstacles, *_walls(half_width)), start, goal, 0.25, 300, (-half_width, half_width))


def _walls(half_width: float) -> tuple[Obstacle, ...]:
    """Four walls about the origin; a wall's yaw points into the room."""
    return tuple(
        Obstacle(WALL, (-half_width * math.cos(yaw), -half_width * math.sin(yaw)), yaw=yaw)
        for yaw in (0.0, 0.5 * math.pi, math.pi, -0.5 * math.pi)
    )


def _place(kind: ArenaKind, rng: np.random.Generator, robot: Robot) -> tuple[Obstacle, ...] | None:
    """Obstacles at least a gap apart, the walls last; None when fewer than the least number found room."""
    walls = _walls(kind.half_width)
    placed: list[Obstacle] = []
    least = 2.0 * robot.footprint + kind.gap
    for shape, (few, many) in ((BOX, kind.boxes), (CYLINDER, kind.cylinders)):
        for i in range(int(rng.integers(few, many, endpoint=True))):
            candidates = [_draw_obstacle(shape, kind, least, rng) for _ in range(CANDIDATES)]
            fitting = np.flatnonzero(gaps(candidates, (*placed, *walls)) >= least)
            if len(fitting):
                placed.append(candidates[fitting[0]])
            elif i < few:
                return None
    return (*placed, *walls)


def _draw_obstacle(shape: str, kind: ArenaKind, least: float, rng: np.random.Generator) -> Obstacle:
    """One that is at least `least` m from the walls, but for the corners of boxes."""
    if shape == CYLINDER:
        size: tuple[float, ...] = (float(rng.uniform(*kind.radius)),)
        yaw, extent = 0.0, size[0]
    else:
        length, width = rng.uniform(*kind.edge, 2)
        size = (float(length), float(length if kind.square else width))
        yaw, extent = float(rng.uniform(-math.pi, math.pi)), 0.5 * min(size)
    within = kind.half_width - least - extent
    x, y = rng.uniform(-within, within, 2)
    return Obstacle(shape, (float(x), float(y)), size, yaw)


def _outline(obstacle: Obstacle) -> tuple[Array, float]:
    """Points (5, 2) and a radius: the points' convex hull, grown by the radius, is a cylinder's or box's plan."""
    if obstacle.kind == CYLINDER:
        return np.tile(obstacle.position, (5, 1)), obstacle.size[0]
    cos, sin = math.cos(obstacle.yaw), math.sin(obstacle.yaw)
    corners = 0.5 * np.array([(1, 1), (1, -1), (-1, 1), (-1, -1), (0, 0)]) * obstacle.size
    return corners @ np.array([(cos, sin), (-sin, cos)]) + obstacle.position, 0.0


def gaps(candidates: Sequence[Obstacle], others: Sequence[Obstacle]) -> Array:
    """From each candidate (cylinder or box) the way to the nearest other, in m; 0 or less on overlap. Shape (k,).

    Two disjoint convex polygons are closest at a corner of one of them: the corners of each are measured to the other.
    """
    mine = [_outline(candidate) for candidate in candidates]
    points, radii = np.stack([outline[0] for outline in mine]), np.array([outline[1] for outline in mine])
    least = Shapes.of(others, dim=2).distance(points).min(axis=(0, 2)) - radii
    theirs = [_outline(other) for other in others if other.kind != WALL]
    if theirs:
        corners, grown = np.stack([outline[0] for outline in theirs]), np.array([outline[1] for outline in theirs])
        back = Shapes.of(candidates, dim=2).distance(corners).min(axis=2) - grown
        least = np.minimum(least, back.min(axis=1))
    return np.asarray(least)


def _start_and_goal(
    kind: ArenaKind, obstacles: tuple[Obstacle, ...], rng: np.random.Generator, robot: Robot
) -> tuple[tuple[float, float], tuple[float, float]] | None:
    """Two free points far enough apart, or None."""
    points = rng.uniform(-kind.half_width, kind.half_width, (64, 2))
    free = Shapes.of(obstacles, dim=2).distance(points).min(axis=0) >= robot.footprint + kind.start_clearance
    points = points[free]
    if not len(points):
        return None
    far = np.linalg.norm(points - points[0], axis=1) >= kind.goal_distance
    if not far.any():
        return None
    start, goal = points[0], points[far][0]
    return (float(start[0]), float(start[1])), (float(goal[0]), float(goal[1]))

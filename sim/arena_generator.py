"""How an arena of a task is drawn: at random, so that a way through exists.

An arena in space is drawn as a plan whose obstacles then get heights: pillars from floor to ceiling, boxes that stand
on the floor or hang from the ceiling, spheres that float.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from brakeline.messaging.obstacle import BOX, CYLINDER, SPHERE, WALL, Obstacle, Shapes
from brakeline.messaging.robot import Robot
from brakeline.messaging.task import ArenaKind, MoverKind, RobotWithTask
from brakeline.sim.arena import Arena, room_boundary, room_bounds, same_room
from brakeline.sim.traffic import Crowd

Array = NDArray[np.float64]


class UnknownArena(ValueError):
    """The robot has no arena of that name."""


class NoArena(RuntimeError):
    """No draw of an arena kind had a way from start to goal: its numbers ask for too much."""


ATTEMPTS = 1000  # whole arenas drawn before giving up
CANDIDATES = 12  # drawn at once for each obstacle, of which the first that fits stays
ENDS = 64  # points drawn at once, of which the first two that are free and far apart are start and goal


def bounds_of(kind: ArenaKind) -> tuple[tuple[float, float], ...]:
    """Lowest and highest coordinate inside the room, for each axis."""
    return room_bounds(kind.half_width, kind.height)


def arena_kind(robot: RobotWithTask, name: str) -> ArenaKind:
    """Raises UnknownArena with the names there are for this robot."""
    kinds = robot.task.arenas
    if name not in kinds:
        there = ", ".join(sorted(kinds)) or "none"
        raise UnknownArena(f"no arena is called {name!r}; there are: {there} ({robot.kind})")
    return kinds[name]


def draw_arena(name: str, rng: np.random.Generator, robot: RobotWithTask) -> Arena:
    """An arena of that name in which `robot` can get from start to goal.

    Raises:
        UnknownArena: with the names there are.
        NoArena: when a kind's numbers leave no solvable arena.
    """
    kind = arena_kind(robot, name)
    if kind.ring is not None:
        return draw_fleet(name, rng, robot, 1)[0]
    for _ in range(ATTEMPTS):
        obstacles = _place(kind, rng, robot)
        if obstacles is None:
            continue
        ends = _start_and_goal(kind, obstacles, rng, robot)
        if ends is None:
            continue
        start, goal = ends
        if robot.heading is not None:
            start = (*start, float(rng.uniform(-math.pi, math.pi)))
        arena = Arena(name, obstacles, start, goal, kind.goal_radius, kind.step_limit, bounds_of(kind))
        if arena.clearance_map.connected(start[: arena.dim], goal, robot.footprint + kind.path_clearance):
            return arena if kind.movers is None else _with_movers(arena, kind.movers, rng)
    raise NoArena(f"no arena {name!r} with a way from start to goal in {ATTEMPTS} draws")


def draw_fleet(name: str, rng: np.random.Generator, robot: RobotWithTask, size: int) -> tuple[Arena, ...]:
    """The same arena for several robots, each with a start and a goal of its own.

    Raises:
        UnknownArena: with the names there are.
        NoArena: when a kind's numbers leave no room for so many.
    """
    kind = arena_kind(robot, name)
    for _ in range(ATTEMPTS):
        obstacles = _place(kind, rng, robot)
        if obstacles is None:
            continue
        ends = _ends(kind, Shapes.of(obstacles, robot.position_dim), rng, robot, size)
        if ends is None:
            continue
        starts, goals = (tuple(map(tuple, points.tolist())) for points in ends)
        first = Arena(name, obstacles, starts[0], goals[0], kind.goal_radius, kind.step_limit, bounds_of(kind))
        wide = robot.footprint + kind.path_clearance
        if not all(first.clearance_map.connected(*way, wide) for way in zip(starts, goals, strict=True)):
            continue
        headings = rng.uniform(-math.pi, math.pi, size)
        return tuple(
            same_room(first, start=(*start, float(heading)), goal=goal)
            for start, goal, heading in zip(starts, goals, headings, strict=True)
        )
    raise NoArena(f"no arena {name!r} with ways for {size} robots in {ATTEMPTS} draws: ask for fewer")


def _ends(
    kind: ArenaKind, shapes: Shapes, rng: np.random.Generator, robot: Robot, size: int
) -> tuple[Array, Array] | None:
    """Starts and goals (size, d) of a fleet: opposite each other on the kind's ring, else anywhere; None: no room."""
    low, high = np.array(bounds_of(kind)).T
    clear = robot.footprint + kind.start_clearance
    apart = 2.0 * clear
    if kind.ring is not None:
        angles = rng.uniform(0.0, math.tau) + math.tau * (np.arange(size) / size)
        starts = kind.ring * np.column_stack([np.cos(angles), np.sin(angles)])
        goals = -starts
    else:
        starts, goals = rng.uniform(low, high, (2, size, len(low)))
        if (np.linalg.norm(starts - goals, axis=1) < kind.goal_distance).any():
            return None
    for points, least in ((starts, apart), (goals, apart + 2.0 * kind.goal_radius)):
        if (shapes.distance(points).min(axis=0) < clear).any():
            return None
        between = np.linalg.norm(points[:, None] - points, axis=-1) + np.diag(np.full(size, np.inf))
        if between.min() < (least if kind.ring is None else apart):
            return None
    return starts, goals


def _with_movers(arena: Arena, kind: MoverKind, rng: np.random.Generator) -> Arena:
    """The arena with movers at free places off the start; they may be fewer than the least where there is no room."""
    low, high = np.array(arena.bounds).T
    points = rng.uniform(low, high, (ENDS, arena.dim))
    free = arena.shapes.distance(points).min(axis=0) >= kind.radius + 0.1
    free &= np.linalg.norm(points - arena.start[: arena.dim], axis=1) >= kind.radius + kind.keep
    places = points[free][: int(rng.integers(*kind.count, endpoint=True))]
    return replace(arena, crowd=Crowd(kind, places, arena.shapes, int(rng.integers(2**31))))


def goal_sequence(arena: Arena, goals: int, rng: np.random.Generator, robot: RobotWithTask) -> tuple[Arena, ...]:
    """The same arena with one goal after another, for a robot that is not put back: each start is the goal before.

    Raises:
        UnknownArena: the robot has no arena of that name.
        NoArena: no goals were found that a way leads to.
    """
    kind, stages, start = arena_kind(robot, arena.name), list[Arena](), arena.start[: arena.dim]
    low, high = np.array(bounds_of(kind)).T
    for _ in range(ATTEMPTS):
        if len(stages) == goals:
            return tuple(stages)
        points = rng.uniform(low, high, (ENDS, arena.dim))
        free = arena.shapes.distance(points).min(axis=0) >= robot.footprint + kind.start_clearance
        far = np.linalg.norm(points - start, axis=1) >= kind.goal_distance
        for goal in (tuple(point) for point in points[free & far].tolist()):
            if arena.clearance_map.connected(start, goal, robot.footprint + kind.path_clearance):
                stages.append(same_room(arena, start=start, goal=goal))
                start = goal
                break
    raise NoArena(f"no {goals} goals that a way leads to in {arena.name!r}")


def _place(kind: ArenaKind, rng: np.random.Generator, robot: Robot) -> tuple[Obstacle, ...] | None:
    """Obstacles at least a gap apart in plan, what closes the room last; None: fewer than the least found room."""
    walls = room_boundary(kind.half_width, None)
    placed: list[Obstacle] = []
    least = 2.0 * robot.footprint + kind.gap
    for shape, (few, many) in ((BOX, kind.boxes), (CYLINDER, kind.cylinders), (SPHERE, kind.spheres)):
        for i in range(int(rng.integers(few, many, endpoint=True))):
            candidates = [_draw_obstacle(shape, kind, least, rng) for _ in range(CANDIDATES)]
            fitting = np.flatnonzero(gaps(candidates, (*placed, *walls)) >= least)
            if len(fitting):
                placed.append(candidates[fitting[0]])
            elif i < few:
                return None
    if kind.height is not None:
        placed = [_lift(obstacle, kind, kind.height, rng) for obstacle in placed]
    return (*placed, *room_boundary(kind.half_width, kind.height))


def _draw_obstacle(shape: str, kind: ArenaKind, least: float, rng: np.random.Generator) -> Obstacle:
    """The plan of one that is at least `least` m from the walls, but for the corners of boxes."""
    if shape == BOX:
        length, width = rng.uniform(*kind.edge, 2)
        size: tuple[float, ...] = (float(length), float(length if kind.square else width))
        yaw, extent = float(rng.uniform(-math.pi, math.pi)), 0.5 * min(size)
    else:
        size = (float(rng.uniform(*(kind.radius if shape == CYLINDER else kind.ball))),)
        yaw, extent = 0.0, size[0]
    within = kind.half_width - least - extent
    x, y = rng.uniform(-within, within, 2)
    return Obstacle(shape, (float(x), float(y)), size, yaw)


def _lift(plan: Obstacle, kind: ArenaKind, height: float, rng: np.random.Generator) -> Obstacle:
    """The obstacle in space whose plan this is."""
    if plan.kind == SPHERE:
        z = float(rng.uniform(plan.size[0], height - plan.size[0]))
        return Obstacle(SPHERE, (*plan.position, z), plan.size)
    if plan.kind == CYLINDER:
        return Obstacle(CYLINDER, (*plan.position, 0.5 * height), (*plan.size, height))
    tall = float(rng.uniform(*kind.tall))
    z = height - 0.5 * tall if rng.random() < 0.5 else 0.5 * tall
    return Obstacle(BOX, (*plan.position, z), (*plan.size, tall), plan.yaw)


@lru_cache(maxsize=1024)
def _outline(obstacle: Obstacle) -> tuple[Array, float]:
    """Points (5, 2) and a radius: the points' convex hull, grown by the radius, is the obstacle's plan."""
    if obstacle.kind != BOX:
        return np.tile(obstacle.position, (5, 1)), obstacle.size[0]
    cos, sin = math.cos(obstacle.yaw), math.sin(obstacle.yaw)
    corners = 0.5 * np.array([(1, 1), (1, -1), (-1, 1), (-1, -1), (0, 0)]) * obstacle.size
    return corners @ np.array([(cos, sin), (-sin, cos)]) + obstacle.position, 0.0


def gaps(candidates: Sequence[Obstacle], others: Sequence[Obstacle]) -> Array:
    """From each candidate (in the plane, no wall) the way to the nearest other, in m; 0 or less on overlap. Shape (k,).

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
) -> tuple[tuple[float, ...], tuple[float, ...]] | None:
    """Two free points far enough apart, or None."""
    low, high = np.array(bounds_of(kind)).T
    points = rng.uniform(low, high, (ENDS, len(low)))
    free = Shapes.of(obstacles, dim=len(low)).distance(points).min(axis=0) >= robot.footprint + kind.start_clearance
    points = points[free]
    if not len(points):
        return None
    far = np.linalg.norm(points - points[0], axis=1) >= kind.goal_distance
    if not far.any():
        return None
    return tuple(points[0].tolist()), tuple(points[far][0].tolist())

"""Draw random arenas of a task in which the robot can get from start to goal.

An arena in space starts as a plan in the plane. Its obstacles then get heights: pillars from floor to ceiling, boxes
that stand on the floor or hang from the ceiling, spheres that float.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np

from brakeline.errors import NoArena
from brakeline.messaging.arena_kinds import ArenaKind, MoverKind
from brakeline.messaging.obstacle import BOX, CYLINDER, SPHERE, Array, Obstacle, Shapes
from brakeline.messaging.robot import Robot
from brakeline.messaging.task import RobotWithTask, arena_kind
from brakeline.sim.arena import Arena, room_boundary, room_bounds, same_room
from brakeline.sim.grid_planner import nearest_distances
from brakeline.sim.traffic import Crowd

ATTEMPTS = 1000  # arenas drawn before giving up
CANDIDATES = 12  # drawn for each obstacle; the first that fits stays
POINTS = 64  # drawn at once for start, goal and moving obstacles
MOVER_GAP = 0.1  # m, least distance of a moving obstacle to static ones at the start

# Of k obstacles in the plane
Candidates = tuple[Array, Array, Array]  # positions (k, 2), sizes (k, 1 or 2), yaws (k,)
Outlines = tuple[Array, Array, Array, Array]  # as of `Shapes`: center (k, 2), axes (k, 2, 2), half (k, 2), rho (k,)


def draw_arena(name: str, rng: np.random.Generator, robot: RobotWithTask) -> Arena:
    """Draw an arena in which a robot can get from start to goal.

    Raises:
        UnknownName: the robot has no arena of this name.
        NoArena: no draw has a path from start to goal.
    """
    kind = arena_kind(robot, name)
    if kind.ring is not None:
        return draw_fleet(name, rng, robot, 1)[0]
    for obstacles in _rooms(kind, rng, robot):
        ends = _start_and_goal(kind, obstacles, rng, robot)
        if ends is None:
            continue
        start, goal = ends
        if robot.heading is not None:
            start = (*start, float(rng.uniform(-math.pi, math.pi)))
        arena = _arena(name, kind, obstacles, start, goal)
        if arena.clearance_map.connected(start[: arena.dim], goal, robot.footprint + kind.path_clearance):
            return arena if kind.movers is None else _with_movers(arena, kind.movers, rng)
    raise NoArena(
        f"none of {ATTEMPTS} drawn arenas {name!r} has a path from start to goal for a robot with a radius of "
        f"{robot.footprint:.2g} m. In [arenas.{name}] of the task's file, increase half_width ({kind.half_width:g} m), "
        f"or decrease the numbers and sizes of obstacles, gap ({kind.gap:g} m), path_clearance "
        f"({kind.path_clearance:g} m) or goal_distance ({kind.goal_distance:g} m)"
    )


def draw_fleet(name: str, rng: np.random.Generator, robot: RobotWithTask, size: int) -> tuple[Arena, ...]:
    """Draw one arena for several robots, each with its own start and goal.

    Raises:
        UnknownName: the robot has no arena of this name.
        NoArena: no draw has room for so many robots.
    """
    kind = arena_kind(robot, name)
    for obstacles in _rooms(kind, rng, robot):
        points = _fleet_ends(kind, Shapes.of(obstacles, robot.position_dim), rng, robot, size)
        if points is None:
            continue
        starts, goals = (tuple(map(tuple, side.tolist())) for side in points)
        first = _arena(name, kind, obstacles, starts[0], goals[0])
        clearance = robot.footprint + kind.path_clearance
        if not all(first.clearance_map.connected(*ends, clearance) for ends in zip(starts, goals, strict=True)):
            continue
        headings = rng.uniform(-math.pi, math.pi, size)
        return tuple(
            same_room(first, start=(*start, float(heading)), goal=goal)
            for start, goal, heading in zip(starts, goals, headings, strict=True)
        )
    raise NoArena(f"none of {ATTEMPTS} drawn arenas {name!r} has paths for {size} robots; use fewer robots")


def _arena(
    name: str, kind: ArenaKind, obstacles: tuple[Obstacle, ...], start: tuple[float, ...], goal: tuple[float, ...]
) -> Arena:
    bounds = room_bounds(kind.half_width, kind.height)
    return Arena(name, obstacles, start, goal, kind.goal_radius, kind.step_limit, bounds)


def _fleet_ends(
    kind: ArenaKind, shapes: Shapes, rng: np.random.Generator, robot: Robot, size: int
) -> tuple[Array, Array] | None:
    """Draw starts and goals (size, d) [m], opposite each other on the kind's ring, or anywhere; None without room."""
    low, high = np.array(room_bounds(kind.half_width, kind.height)).T
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
        if (nearest_distances(shapes, points) < clear).any():
            return None
        between = np.linalg.norm(points[:, None] - points, axis=-1) + np.diag(np.full(size, np.inf))
        if between.min() < (least if kind.ring is None else apart):
            return None
    return starts, goals


def _with_movers(arena: Arena, kind: MoverKind, rng: np.random.Generator) -> Arena:
    """Add moving obstacles at free positions away from the start.

    If there is no room, the arena gets fewer of them than the kind's least number.
    """
    points = _free_points(arena.shapes, arena.bounds, kind.radius + MOVER_GAP, rng)
    away = np.linalg.norm(points - arena.start[: arena.dim], axis=1) >= kind.radius + kind.keep
    positions = points[away][: int(rng.integers(*kind.count, endpoint=True))]
    return replace(arena, crowd=Crowd(kind, positions, arena.shapes, int(rng.integers(2**31))))


def goal_sequence(arena: Arena, goals: int, rng: np.random.Generator, robot: RobotWithTask) -> tuple[Arena, ...]:
    """Return the same arena with one goal after another: each start is the goal before.

    Raises:
        UnknownName: the robot has no arena of this name.
        NoArena: no path leads to further goals.
    """
    kind, stages, start = arena_kind(robot, arena.name), list[Arena](), arena.start[: arena.dim]
    for _ in range(ATTEMPTS):
        if len(stages) == goals:
            return tuple(stages)
        points = _free_points(arena.shapes, arena.bounds, robot.footprint + kind.start_clearance, rng)
        far = np.linalg.norm(points - start, axis=1) >= kind.goal_distance
        for goal in (tuple(point) for point in points[far].tolist()):
            if arena.clearance_map.connected(start, goal, robot.footprint + kind.path_clearance):
                stages.append(same_room(arena, start=start, goal=goal))
                start = goal
                break
    raise NoArena(f"no sequence of {goals} goals with paths between them in the arena {arena.name!r}")


def _rooms(kind: ArenaKind, rng: np.random.Generator, robot: Robot) -> Iterator[tuple[Obstacle, ...]]:
    """Draw `ATTEMPTS` rooms; yield the obstacles of those that have enough of them."""
    for _ in range(ATTEMPTS):
        if (obstacles := _place(kind, rng, robot)) is not None:
            yield obstacles


def _place(kind: ArenaKind, rng: np.random.Generator, robot: Robot) -> tuple[Obstacle, ...] | None:
    """Draw obstacles with gaps between their outlines, then the room's boundary; None if too few obstacles fit."""
    from brakeline.sim.kernels.arena_kernels import first_fitting

    placed = list[Obstacle]()
    outlines: Outlines = Shapes.of(room_boundary(kind.half_width, None), dim=2).parts[:4]
    least = 2.0 * robot.footprint + kind.gap
    for shape, (few, many) in ((BOX, kind.boxes), (CYLINDER, kind.cylinders), (SPHERE, kind.spheres)):
        for i in range(int(rng.integers(few, many, endpoint=True))):
            candidates = _draw_candidates(shape, kind, least, rng)
            drawn = _outlines(shape, candidates)
            fitting = first_fitting(*drawn, *outlines, least)
            if fitting >= 0:
                position, size, yaw = (values[fitting].tolist() for values in candidates)
                placed.append(Obstacle(shape, tuple(position), tuple(size), yaw))
                outlines = _joined(outlines, drawn, fitting)
            elif i < few:
                return None
    if kind.height is not None:
        placed = [_lift(obstacle, kind, kind.height, rng) for obstacle in placed]
    return (*placed, *room_boundary(kind.half_width, kind.height))


def _draw_candidates(shape: str, kind: ArenaKind, least: float, rng: np.random.Generator) -> Candidates:
    """Draw obstacles in the plane at least `least` m from the walls; corners of boxes may be nearer."""
    low, high = kind.edge if shape == BOX else kind.radius if shape == CYLINDER else kind.ball
    shares = rng.random((CANDIDATES, 5 if shape == BOX else 3))
    sizes = low + (high - low) * shares[:, : 2 if shape == BOX else 1]
    yaws = -math.pi + math.tau * shares[:, 2] if shape == BOX else np.zeros(CANDIDATES)
    if shape == BOX and kind.square:
        sizes[:, 1] = sizes[:, 0]
    within = (kind.half_width - least - sizes.min(axis=1) * (0.5 if shape == BOX else 1.0))[:, None]
    return -within + 2.0 * within * shares[:, -2:], sizes, yaws


def _outlines(shape: str, candidates: Candidates) -> Outlines:
    positions, sizes, yaws = candidates
    cos, sin = np.cos(yaws), np.sin(yaws)
    axes = np.stack((cos, -sin, sin, cos), axis=-1).reshape(-1, 2, 2)
    if shape == BOX:
        return positions, axes, 0.5 * sizes, np.zeros(len(yaws))
    return positions, axes, np.zeros_like(positions), sizes[:, 0].copy()


def _joined(outlines: Outlines, others: Outlines, row: int) -> Outlines:
    center, axes, half, rho = (
        np.concatenate((before, new[row, None])) for before, new in zip(outlines, others, strict=True)
    )
    return center, axes, half, rho


def _lift(plan: Obstacle, kind: ArenaKind, height: float, rng: np.random.Generator) -> Obstacle:
    """Return the obstacle in space that has this plan."""
    if plan.kind == SPHERE:
        z = float(rng.uniform(plan.size[0], height - plan.size[0]))
        return Obstacle(SPHERE, (*plan.position, z), plan.size)
    if plan.kind == CYLINDER:
        return Obstacle(CYLINDER, (*plan.position, 0.5 * height), (*plan.size, height))
    box_height = float(rng.uniform(*kind.tall))
    z = height - 0.5 * box_height if rng.random() < 0.5 else 0.5 * box_height
    return Obstacle(BOX, (*plan.position, z), (*plan.size, box_height), plan.yaw)


def _start_and_goal(
    kind: ArenaKind, obstacles: tuple[Obstacle, ...], rng: np.random.Generator, robot: Robot
) -> tuple[tuple[float, ...], tuple[float, ...]] | None:
    """Draw two free points that are far enough apart, or None."""
    shapes, bounds = Shapes.of(obstacles, dim=robot.position_dim), room_bounds(kind.half_width, kind.height)
    points = _free_points(shapes, bounds, robot.footprint + kind.start_clearance, rng)
    far = points[np.linalg.norm(points - points[:1], axis=1) >= kind.goal_distance]
    return (tuple(points[0].tolist()), tuple(far[0].tolist())) if len(far) else None


def _free_points(
    shapes: Shapes, bounds: Sequence[tuple[float, float]], clearance: float, rng: np.random.Generator
) -> Array:
    """Draw points in a room; return those (k, d), at most `POINTS`, with a clearance [m] from every shape."""
    low, high = np.array(bounds).T
    points = rng.uniform(low, high, (POINTS, len(low)))
    return np.asarray(points[nearest_distances(shapes, points) >= clearance])

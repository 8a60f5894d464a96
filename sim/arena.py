"""Arenas: walled rooms with obstacles, a start and a goal, in the plane or in space."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

from brakeline.messaging.obstacle import BOX, WALL, Obstacle, Shapes
from brakeline.sim.grid_planner import ClearanceMap
from brakeline.sim.traffic import Crowd, OtherRobots

SLAB = 2.0  # m, thickness of floors and ceilings


@dataclass(frozen=True)
class Arena:
    """One room, for one episode. Lengths in m, angles in rad, world frame; d = 2 (plane) or 3 (space).

    What closes the room comes last among the obstacles: four walls, in space also floor and ceiling.
    """

    name: str
    obstacles: tuple[Obstacle, ...]  # d-dimensional
    start: tuple[float, ...]  # x, y, heading in the plane; x, y, z in space
    goal: tuple[float, ...]  # (d,)
    goal_radius: float
    step_limit: int  # periods until the episode is cut off
    bounds: tuple[tuple[float, float], ...]  # lowest and highest coordinate inside the room, for each of the d axes
    crowd: Crowd | OtherRobots | None = field(default=None, compare=False)  # what moves in it

    @property
    def dim(self) -> int:
        return len(self.bounds)

    @cached_property
    def shapes(self) -> Shapes:
        return Shapes.of(self.obstacles, dim=self.dim)

    @cached_property
    def clearance_map(self) -> ClearanceMap:
        return ClearanceMap(self.obstacles, self.bounds)


def same_room(arena: Arena, **changes: Any) -> Arena:
    """The same room with another start, goal or crowd; what was made of its obstacles is kept: it costs a period."""
    other = replace(arena, **changes)
    vars(other).update(shapes=arena.shapes, clearance_map=arena.clearance_map)
    return other


def room_bounds(half_width: float, height: float | None) -> tuple[tuple[float, float], ...]:
    """Bounds of a square room about the origin, in space from 0 up to `height`."""
    plan = ((-half_width, half_width),) * 2
    return plan if height is None else (*plan, (0.0, height))


def room_boundary(half_width: float, height: float | None) -> tuple[Obstacle, ...]:
    """What closes that room: four walls whose yaw points into it; in space also a floor and a ceiling.

    Floor and ceiling are boxes whose upper and lower face is the surface: a wall's half-space has a yaw only.
    """
    middle = () if height is None else (0.5 * height,)
    walls = tuple(
        Obstacle(WALL, (-half_width * math.cos(yaw), -half_width * math.sin(yaw), *middle), yaw=yaw)
        for yaw in (0.0, 0.5 * math.pi, math.pi, -0.5 * math.pi)
    )
    if height is None:
        return walls
    size = (2.0 * (half_width + SLAB), 2.0 * (half_width + SLAB), SLAB)
    return (*walls, *(Obstacle(BOX, (0.0, 0.0, z), size) for z in (-0.5 * SLAB, height + 0.5 * SLAB)))


def staged_arena(
    *obstacles: Obstacle,
    start: tuple[float, ...] = (0.0, 0.0, 0.0),
    goal: tuple[float, ...] = (4.0, 4.0),
    half_width: float = 5.0,
    height: float | None = None,
) -> Arena:
    """A closed room about the origin with these obstacles and nothing left to chance, for tests and trials.

    In the plane, unless there is a height: then `start`, `goal` and the obstacles have three coordinates.
    """
    obstacles = (*obstacles, *room_boundary(half_width, height))
    radius = 0.25 if height is None else 1.0
    return Arena("staged", obstacles, start, goal, radius, 300, room_bounds(half_width, height))

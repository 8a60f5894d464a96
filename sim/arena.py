"""Arenas: walled rooms with obstacles, a start and a goal, in the plane or in space."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

from brakeline.messaging.obstacle import BOX, WALL, Obstacle, Shapes
from brakeline.sim.grid_planner import ClearanceMap
from brakeline.sim.traffic import Crowd, OtherRobots

SLAB_THICKNESS = 2.0  # m, of floors and ceilings


@dataclass(frozen=True)
class Arena:
    """One room, for one episode. Lengths in m, angles in rad, world frame; d = 2 (plane) or 3 (space).

    The boundary of the room comes last among the obstacles: four walls, in space also floor and ceiling.
    """

    name: str
    obstacles: tuple[Obstacle, ...]  # d-dimensional
    start: tuple[float, ...]  # x, y, heading in the plane; x, y, z in space
    goal: tuple[float, ...]  # (d,)
    goal_radius: float
    step_limit: int  # periods until the episode is cut off
    bounds: tuple[tuple[float, float], ...]  # (low, high) of the room, for each of the d axes
    crowd: Crowd | OtherRobots | None = field(default=None, compare=False)  # the moving obstacles

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
    """Return the same room with another start, goal or crowd.

    The copy shares `shapes` and `clearance_map`, which take about a period to compute.
    """
    copy = replace(arena, **changes)
    vars(copy).update(shapes=arena.shapes, clearance_map=arena.clearance_map)
    return copy


def room_bounds(half_width: float, height: float | None) -> tuple[tuple[float, float], ...]:
    """Return the bounds of a square room around the origin, in space from 0 up to `height`."""
    plan = ((-half_width, half_width),) * 2
    return plan if height is None else (*plan, (0.0, height))


def room_boundary(half_width: float, height: float | None) -> tuple[Obstacle, ...]:
    """Return the walls of that room, whose yaw points into it; in space also floor and ceiling.

    Floor and ceiling are boxes, because a wall's half-space can only turn about the vertical.
    """
    middle = () if height is None else (0.5 * height,)
    walls = tuple(
        Obstacle(WALL, (-half_width * math.cos(yaw), -half_width * math.sin(yaw), *middle), yaw=yaw)
        for yaw in (0.0, 0.5 * math.pi, math.pi, -0.5 * math.pi)
    )
    if height is None:
        return walls
    size = (2.0 * (half_width + SLAB_THICKNESS), 2.0 * (half_width + SLAB_THICKNESS), SLAB_THICKNESS)
    return (
        *walls,
        *(Obstacle(BOX, (0.0, 0.0, z), size) for z in (-0.5 * SLAB_THICKNESS, height + 0.5 * SLAB_THICKNESS)),
    )

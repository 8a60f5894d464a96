"""The closed room that tests place obstacles in."""

from brakeline.messaging.obstacle import Obstacle
from brakeline.sim.arena import Arena, room_boundary, room_bounds


def staged_arena(
    *obstacles: Obstacle,
    start: tuple[float, ...] = (0.0, 0.0, 0.0),
    goal: tuple[float, ...] = (4.0, 4.0),
    half_width: float = 5.0,
    height: float | None = None,
) -> Arena:
    """Return a closed room around the origin with the given obstacles.

    The room is in the plane. With a `height` it is in space: start, goal and obstacles then have three coordinates.
    """
    obstacles = (*obstacles, *room_boundary(half_width, height))
    radius = 0.25 if height is None else 1.0
    return Arena("staged", obstacles, start, goal, radius, 300, room_bounds(half_width, height))

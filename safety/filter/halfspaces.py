"""Free space about a nominal plan, as half-spaces `a·p <= b` (docs/method.md §3).

Each near obstacle gets one half-space for each period. The obstacle is convex, so the plane through its point c closest
to a nominal position q, with the normal a = (c - q) / |c - q|, has the whole obstacle on its far side. The half-space
must hold at both ends of the period, so that it contains the chord. Of the planes for q at the start, the middle and
the end of the period, the filter takes the one that leaves both ends the most room. A fast robot passes an obstacle
within a period, and a plane for one end alone would exclude the other end.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from brakeline.messaging.obstacle import Array, Shapes

TOUCHING = 1e-6  # m; at a smaller distance the normal is undefined


def rows_per_obstacle(horizon: int) -> int:
    """Return the number of rows (3) for an obstacle: N starts of periods, N ends, and the last end after the stop."""
    return 2 * horizon + 1


def viewpoints(start: Array, nominal: Array) -> tuple[Array, Array]:
    """Return the ends of the periods (N+1, d) of a nominal plan, relative to its start; and with their midpoints."""
    ends = np.concatenate([np.zeros((1, len(start))), nominal - start])
    places = np.empty((2 * len(nominal) + 1, len(start)))
    places[::2] = ends
    places[1::2] = 0.5 * (ends[1:] + ends[:-1])
    return ends, places


def roomiest(room: Array) -> NDArray[np.intp]:
    """Return which plane (n, N) leaves both ends of a period the most room, of those seen from up to its end.

    From the first period on in which no plane keeps apart, the nominal plan meets the obstacle: the plane before stays.

    Args:
        room: (n, N, 2N+1) [m], of the planes that are seen from the `viewpoints`.
    """
    n, N, seen = room.shape
    room = np.where(np.arange(seen) <= 2 * np.arange(1, N + 1)[:, None], room, -np.inf)
    room[np.isnan(room)] = -np.inf
    choice = room.argmax(axis=2)
    met = np.logical_or.accumulate(~(room.max(axis=2) > 0.0), axis=1)
    before = (~met).sum(axis=1)
    last = np.where(before > 0, choice[np.arange(n), before - 1], 0)
    return np.where(met, last[:, None], choice)


def half_spaces(near: Shapes, start: Array, nominal: Array, keep_off: float, measured: Array) -> tuple[Array, Array]:
    """Return half-spaces for the *measured* position that keep the body off the obstacles: b' of docs/method.md §3.

    Args:
        near: n obstacles.
        start: (d,) the position now.
        nominal: (N, d) positions at the ends of the periods.
        keep_off: the footprint's radius [m].
        measured: (d,) half-widths of the position's measurement error.

    Returns:
        normals a (n, N, d) and offsets b (n, N), relative to `start`: `a·(p - start) <= b`. An obstacle that the
        start touches gets `b = -inf`: nothing there can be verified.
    """
    from brakeline.safety.filter.kernels import shape_kernels

    return shape_kernels.planes_beside(*near.parts, near.margin, start, nominal, keep_off, measured)


def half_spaces_leading_out(
    near: Shapes, start: Array, keep_off: float, measured: Array, planes: tuple[Array, Array]
) -> tuple[Array, Array]:
    """Replace the half-spaces of obstacles that contain the start by the plane of their nearest side.

    They verify nothing; recovery uses them to find a way out (docs/method.md §11).
    """
    out = near.to_surface(start)
    depth = np.sqrt(np.einsum("nd,nd->n", out, out))
    inside = depth > TOUCHING
    if not inside.any():
        return planes
    normals, offsets = planes[0].copy(), planes[1].copy()
    normals[inside] = (-out[inside] / depth[inside, None])[:, None]
    distance = np.maximum(keep_off + near.margin[inside], 0.0) + np.abs(normals[inside, 0]) @ measured
    offsets[inside] = -(depth[inside] + distance)[:, None]
    return normals, offsets

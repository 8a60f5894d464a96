"""Free space about a nominal plan, as half-spaces `a·p <= b` (docs/method.md §3).

Each near obstacle gets one half-space for each period. The obstacle is convex, so the plane through its point c closest
to a nominal position q, with the normal a = (c - q) / |c - q|, has the whole obstacle on its far side. The half-space
must hold at both ends of the period, so that it contains the chord. Of the planes for q at the start, the middle and
the end of the period, the filter takes the one that leaves both ends the most room. A fast robot passes an obstacle
within a period, and a plane for one end alone would exclude the other end.
"""

from __future__ import annotations

from functools import cache

import numpy as np
from numpy.typing import NDArray

from brakeline.messaging.obstacle import Shapes

Array = NDArray[np.float64]

TOUCHING = 1e-6  # m; at a smaller distance the normal is undefined


def rows_per_obstacle(horizon: int) -> int:
    """Return the number of rows (3) for an obstacle: N starts of periods, N ends, and the last end after the stop."""
    return 2 * horizon + 1


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
    between = np.concatenate([np.zeros((1, nominal.shape[1])), nominal - start])
    seen_from = np.empty((2 * len(nominal) + 1, nominal.shape[1]))  # relative to the start
    seen_from[::2] = between
    seen_from[1::2] = 0.5 * (between[1:] + between[:-1])
    towards = near.towards(start + seen_from)  # (n, 2N+1, d)
    gap = np.sqrt(np.einsum("nqd,nqd->nq", towards, towards))
    unit = towards / np.maximum(gap, TOUCHING)[..., None]
    level = np.einsum("nqd,nqd->nq", unit, towards + seen_from)
    inside = ~(gap > TOUCHING)  # true for NaN, too
    level[inside | inside[:, :1]] = -np.inf
    choice = roomiest_planes(unit, level, between)
    each = np.arange(len(choice))[:, None]
    normal = unit[each, choice]
    return normal, level[each, choice] - np.maximum(keep_off + near.margin, 0.0)[:, None] - np.abs(normal) @ measured


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
    kept = np.maximum(keep_off + near.margin[inside], 0.0) + np.abs(normals[inside, 0]) @ measured
    offsets[inside] = -(depth[inside] + kept)[:, None]
    return normals, offsets


def roomiest_planes(unit: Array, level: Array, ends: Array) -> NDArray[np.intp]:
    """Return the index (n, N) of the plane, among the 2N+1, that each period uses.

    unit (n, 2N+1, d), level (n, 2N+1): the planes. ends (N+1, d): nominal positions at the ends of the periods.
    From the first period in which no plane separates both ends from the obstacle, the plan crosses the obstacle. The
    plane before then stays in force: a plane from beyond the obstacle would hold on the wrong side.
    """
    places, periods = _places(len(ends) - 1)
    along = unit @ ends.T  # (n, 2N+1, N+1)
    room = level[:, places] - np.maximum(along[:, places, periods], along[:, places, periods + 1])  # (n, N, 3)
    best = room.argmax(axis=2)
    choice: NDArray[np.intp] = 2 * periods[:, 0] + best
    through = np.logical_or.accumulate(~(room.max(axis=2) > 0.0), axis=1)
    if not through.any():
        return choice
    before = (~through).sum(axis=1)  # periods until then
    last = np.where(before > 0, choice[np.arange(len(choice)), before - 1], 0)
    return np.asarray(np.where(through, last[:, None], choice))


@cache
def _places(periods: int) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Return the indices (N, 3) of each period's start, middle and end among the 2N+1 planes, and its number (N, 1)."""
    number = np.arange(periods)[:, None]
    return 2 * number + np.arange(3), number

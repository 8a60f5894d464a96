"""Free space about a nominal plan, as half-spaces `a·p <= b` (docs/method.md §3).

Each near obstacle gets one half-space for each period. The obstacle is convex, so the plane through its point c closest
to a nominal position q, with the normal a = (c - q) / |c - q|, has the whole obstacle on its far side. The half-space
must hold at both ends of the period, so that it contains the chord. Of the planes for q at the start, the middle and
the end of the period, the filter takes the one that leaves both ends the most room. A fast robot passes an obstacle
within a period, and a plane for one end alone would exclude the other end.
"""

from __future__ import annotations

import numpy as np

from brakeline.messaging.obstacle import Array, Shapes

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
    kept = np.maximum(keep_off + near.margin[inside], 0.0) + np.abs(normals[inside, 0]) @ measured
    offsets[inside] = -(depth[inside] + kept)[:, None]
    return normals, offsets

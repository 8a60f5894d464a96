"""Free space about a nominal plan, as half-spaces `a·p <= b` (method §3).

A supporting half-space per near obstacle and period: the obstacle is convex, so the plane through its point closest
to the nominal position, normal to the line between them, has all of it on the far side. The same half-space holds for
both ends of the period, so that the chord between them is inside too.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from messaging.shapes import Shapes

Array = NDArray[np.float64]

TOUCHING = 1e-6  # m; nearer than this a direction can't be told


def half_spaces(near: Shapes, start: Array, nominal: Array, keep_off: float, measured: Array) -> tuple[Array, Array]:
    """Half-spaces for the *measured* position that keep the body off the obstacles.

    Args:
        near: n obstacles.
        start: (d,) the position now.
        nominal: (N, d) positions at the ends of the periods.
        keep_off: the footprint's radius [m].
        measured: (d,) Z_v: half-widths of |measured - true|.

    Returns:
        normals a (n, N, d) and offsets b (n, N), relative to `start`: `a·(p - start) <= b`. An obstacle that the
        start touches gets `b = -inf`: nothing there can be verified.
    """
    towards = near.towards(np.concatenate([start[None], nominal]))
    here, there = towards[:, :1], towards[:, 1:]  # (n, 1, d), (n, N, d)
    closest = there + (nominal - start)  # relative to the start, as `here` is
    # A nominal position inside an obstacle has no direction, and one beyond it a plane that the start is beyond of.
    gap = np.sqrt(np.einsum("nkd,nkd->nk", there, there))
    ahead = (gap > TOUCHING) & (np.einsum("nkd,nkd->nk", there, closest) > 0.0)
    vector = np.where(ahead[..., None], there, here)
    point = np.where(ahead[..., None], closest, here)
    length = np.where(ahead, gap, np.sqrt(np.einsum("nkd,nkd->nk", here, here)))
    normal = vector / np.maximum(length, TOUCHING)[..., None]
    offset = np.einsum("nkd,nkd->nk", normal, point) - keep_off - np.abs(normal) @ measured
    offset[~(length > TOUCHING)] = -np.inf
    return normal, offset

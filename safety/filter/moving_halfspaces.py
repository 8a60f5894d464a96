"""Half-spaces beside moving obstacles, for the whole sweep of a period (docs/method.md §8).

In period k = [t_k, t_{k+1}] an obstacle lies within O + c t ⊕ ball(r(t)). For a unit normal n from the
robot to the obstacle, `n·p <= b` keeps the robot off the obstacle at all of these times if

    b = min over t in {t_k, t_{k+1}} of (the least n·o over O + c t)  -  r(t_{k+1})

O is convex and only translates, so the two ends suffice; r grows, so its last value suffices. Normals point from
nominal positions (start, middle and end of each period up to this one) to the closest point of the moved shape. The
filter takes the plane that leaves both ends the most room.
"""

from __future__ import annotations

import numpy as np

from brakeline.messaging.moving_obstacles import MovingObstacles
from brakeline.messaging.robot import Array
from brakeline.safety.filter.halfspaces import TOUCHING, roomiest, viewpoints


def swept_half_spaces(
    near: MovingObstacles, start: Array, nominal: Array, keep_off: float, measured: Array, period: float
) -> tuple[Array, Array]:
    """Return half-spaces as `half_spaces` does, for moving obstacles. period [s]: between two nominal positions."""
    n, N = len(near), nominal.shape[0]
    ends, places = viewpoints(start, nominal)
    seen_from = places - near.moved(0.5 * period * np.arange(2 * N + 1))  # (n, q, d), as if the obstacle stood
    rows = np.arange(n)[:, None]
    towards = near.shapes.towards_from_own_points(start + seen_from)
    gap = np.sqrt(np.einsum("nqd,nqd->nq", towards, towards))
    unit = towards / np.maximum(gap, TOUCHING)[..., None]
    level = np.einsum("nqd,nqd->nq", unit, towards + seen_from)  # least n·o over O where it was measured
    level[~(gap > TOUCHING)] = -np.inf  # true for NaN, too
    times = period * np.arange(N + 1)
    along = np.einsum("nqd,nkd->nqk", unit, near.moved(times))
    bound = level[:, :, None] + np.minimum(along[:, :, :-1], along[:, :, 1:]) - near.radius(times[1:])[:, None]
    room = unit @ ends.T
    room = bound - np.maximum(room[:, :, :-1], room[:, :, 1:])  # (n, q, N)
    choice = roomiest(room.swapaxes(1, 2))
    normal = unit[rows, choice]
    offset = bound[rows, choice, np.arange(N)] - np.maximum(keep_off + near.shapes.margin, 0.0)[:, None]
    offset -= np.abs(normal) @ measured
    return normal, np.where(np.isnan(offset), -np.inf, offset)

"""Compiled loops over half-spaces and the ends of a tube's periods (docs/method.md §3, §4).

A tube has E = 2N + 1 *ends* for each half-space of an obstacle: the start and the end of each period, and the end of
the plan once more. The arguments that describe them come from `qp.ObstacleRows`:

    position (N, d, nz), offset (N, d): affine maps from regressors z to the position after each period
    stretch (N,) or none: factors on the generators after each period
    end (E,): the number of periods after which the end is. Where it is 0, the position is the start itself
    period (E,): the period whose half-space holds at the end
    end_directions (E, d, K), columns (E, K): generators that are not zero there, and their indices among all L
    extra (E,): index of the magnitude that is added in all directions: a chord deviation or the stopping distance

`tests/safety/kernel_twins.py` has each function in plain NumPy.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from brakeline.compilation import compiled

Array = NDArray[np.float64]
Index = NDArray[np.int64]


@compiled(
    "Tuple((f8[:,::1], f8[:,::1], f8[::1]))"
    "(f8[:,:,::1], f8[:,::1], f8[:,:,::1], f8[:,:], f8[::1],"
    " i8[::1], i8[::1], f8[:,:,::1], i8[:,::1], i8[::1], i8, f8)"
)
def rows(
    normals: Array,
    offsets: Array,
    position: Array,
    offset: Array,
    stretch: Array,
    end: Index,
    period: Index,
    end_directions: Array,
    columns: Index,
    extra: Index,
    sizes: int,
    widening: float,
) -> tuple[Array, Array, Array]:
    """Return the rows (3) of half-spaces with normals a (n, N, d) and offsets b (n, N). widening: factor on the sets.

    Returns:
        Gradient (n·E, nz), spread (n·E, sizes) and bound (n·E,).
    """
    n, ends, d, nz = len(normals), len(period), position.shape[1], position.shape[2]
    gradient, spread, bound = np.zeros((n * ends, nz)), np.zeros((n * ends, sizes)), np.empty(n * ends)
    for i in range(n):
        for e in range(ends):
            row, normal, after = i * ends + e, normals[i, period[e]], end[e] - 1
            bound[row] = offsets[i, period[e]]
            if after >= 0:
                factor = stretch[after] if len(stretch) else 1.0
                for axis in range(d):
                    bound[row] -= normal[axis] * offset[after, axis]
                    for j in range(nz):
                        gradient[row, j] += normal[axis] * position[after, axis, j]
                for k in range(columns.shape[1]):
                    along = 0.0
                    for axis in range(d):
                        along += normal[axis] * (factor * end_directions[e, axis, k])
                    spread[row, columns[e, k]] = abs(along) * widening
            spread[row, extra[e]] = widening
    return gradient, spread, bound


@compiled(
    "f8[::1]"
    "(f8[:,:,::1], f8[:,::1], f8[:,:,::1], f8[:,:], f8[::1],"
    " i8[::1], i8[::1], f8[:,:,::1], i8[:,::1], i8[::1], f8[::1], f8[::1])"
)
def slack(
    normals: Array,
    offsets: Array,
    position: Array,
    offset: Array,
    stretch: Array,
    end: Index,
    period: Index,
    end_directions: Array,
    columns: Index,
    extra: Index,
    sizes: Array,
    z: Array,
) -> Array:
    """Return the slack of the rows (3), bound - gradient z - spread sizes (n·E,), without building the rows.

    sizes (L+N+1,): the tube's magnitudes under regressors z. NaN in a half-space or in z gives NaN.
    """
    n, ends, d = len(normals), len(period), position.shape[1]
    remaining, a = np.empty((n, ends)), np.zeros((3, n))
    for e in range(ends):
        after, reached = end[e] - 1, np.full(n, sizes[extra[e]])
        for axis in range(d):
            for i in range(n):
                a[axis, i] = normals[i, period[e], axis]
        at = np.zeros(3)
        for axis in range(d):
            if after >= 0:
                at[axis] = offset[after, axis]
                for j in range(position.shape[2]):
                    at[axis] += position[after, axis, j] * z[j]
            for i in range(n):
                reached[i] += a[axis, i] * at[axis]
        if after >= 0:
            factor = stretch[after] if len(stretch) else 1.0
            for k in range(columns.shape[1]):
                span, size = np.zeros(3), sizes[columns[e, k]]
                for axis in range(d):
                    span[axis] = factor * end_directions[e, axis, k]
                u, v, w = span[0], span[1], span[2]
                for i in range(n):
                    reached[i] += abs(a[0, i] * u + a[1, i] * v + a[2, i] * w) * size
        for i in range(n):
            remaining[i, e] = offsets[i, period[e]] - reached[i]
    return remaining.ravel()


@compiled("f8(f8[::1], f8)")
def least(remaining: Array, most: float) -> float:
    """Return the smallest of `most` and all values (r,), or NaN if one value is NaN."""
    smallest, numbers = most, True
    for row in range(len(remaining)):
        smallest = remaining[row] if remaining[row] < smallest else smallest
        numbers &= remaining[row] == remaining[row]
    return smallest if numbers else np.nan


@compiled(
    "f8[:,:,::1](f8[:,::1], f8[:,::1], f8[:,::1], f8[::1], f8[:,:,::1], f8[:,:], f8[:,:,::1], f8[:,:,::1], f8, f8[::1],"
    " f8[::1], f8[::1], f8[::1], f8[:,::1])"
)
def filled_by_plans(
    W: Array,
    W_free: Array,
    M: Array,
    m_0: Array,
    position: Array,
    offset: Array,
    position_free: Array,
    directions: Array,
    widening: float,
    z: Array,
    radius: Array,
    beside: Array,
    start: Array,
    turn: Array,
) -> Array:
    """Return corners (2, N+1, d), lower and upper, world, of boxes that contain all plans now and at each period's end.

    W, M, m_0, position, offset: of the tube. W_free, position_free: absolute values of their columns for the free
    inputs; directions (N, d, L): absolute values of the tube's; widening: factor on its sets. The free inputs of a plan
    are within `radius` (F·m,) of those in z. Each box is wider by beside (d,) and by the largest chord deviation or
    stopping distance.
    """
    (N, d, L), q = directions.shape, len(W)
    atoms, sizes = np.empty(q), m_0.copy()
    for i in range(q):
        center, radius_of_atom = 0.0, 0.0
        for j in range(len(z)):
            center += W[i, j] * z[j]
        for j in range(len(radius)):
            radius_of_atom += W_free[i, j] * radius[j]
        atoms[i] = abs(center) + radius_of_atom
    for k in range(len(sizes)):
        for i in range(q):
            sizes[k] += M[k, i] * atoms[i]
        sizes[k] *= widening
    chord_deviation = sizes[L:].max()
    center_of, half, boxes = np.empty(d), np.empty(d), np.zeros((2, N + 1, d))
    for k in range(N):
        for axis in range(d):
            center_of[axis], half[axis] = offset[k, axis], beside[axis] + chord_deviation
            for j in range(len(z)):
                center_of[axis] += position[k, axis, j] * z[j]
            for j in range(len(radius)):
                half[axis] += position_free[k, axis, j] * radius[j]
            for j in range(L):
                half[axis] += directions[k, axis, j] * sizes[j]
        for axis in range(d):
            middle, aside = start[axis], 0.0
            for other in range(d):
                middle += turn[axis, other] * center_of[other]
                aside += abs(turn[axis, other]) * half[other]
            boxes[0, k + 1, axis], boxes[1, k + 1, axis] = middle - aside, middle + aside
            if k == 0:
                boxes[0, 0, axis], boxes[1, 0, axis] = start[axis] - aside, start[axis] + aside
    return boxes

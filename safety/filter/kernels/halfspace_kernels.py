"""Half-spaces held against the ends of a tube, compiled: as rows, what is left of them, and which of them matter to
a QP (`program.py`).

Of E ends each has the half-spaces of one period (E,); the ways (E, d, nz) that regressors lead there; K generators,
their directions (E, d, K) and which of all they are (E, K); and one magnitude (E,) that adds to it on all sides.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from brakeline.safety.compilation import compiled

Array = NDArray[np.float64]
Index = NDArray[np.int64]


@compiled(
    "Tuple((f8[:,::1], f8[:,::1], f8[::1]))"
    "(f8[:,:,::1], f8[:,::1], i8[::1], f8[:,:,::1], f8[:,:,::1], i8[:,::1], i8[::1], i8)"
)
def rows(
    normals: Array, offsets: Array, period: Index, ways: Array, spans: Array, used: Index, about: Index, sizes: int
) -> tuple[Array, Array, Array]:
    """gradient (n·E, nz), spread (n·E, sizes) and bound (n·E,) of half-spaces (n, N, d), (n, N)."""
    n, ends, d, nz = len(normals), len(period), ways.shape[1], ways.shape[2]
    gradient, spread, bound = np.zeros((n * ends, nz)), np.zeros((n * ends, sizes)), np.empty(n * ends)
    for i in range(n):
        for e in range(ends):
            row, normal = i * ends + e, normals[i, period[e]]
            bound[row] = offsets[i, period[e]]
            for axis in range(d):
                for j in range(nz):
                    gradient[row, j] += normal[axis] * ways[e, axis, j]
            for k in range(used.shape[1]):
                along = 0.0
                for axis in range(d):
                    along += normal[axis] * spans[e, axis, k]
                spread[row, used[e, k]] = abs(along)
            spread[row, about[e]] = 1.0
    return gradient, spread, bound


@compiled("f8[::1](f8[:,:,::1], f8[:,::1], i8[::1], f8[:,:,::1], f8[:,:,::1], i8[:,::1], i8[::1], f8[::1], f8[::1])")
def slack(
    normals: Array,
    offsets: Array,
    period: Index,
    ways: Array,
    spans: Array,
    used: Index,
    about: Index,
    sizes: Array,
    z: Array,
) -> Array:
    """bound - gradient z - spread sizes (n·E,) of the same rows, for all half-spaces of an end at once."""
    n, ends, d = len(normals), len(period), ways.shape[1]
    left, a = np.empty((n, ends)), np.zeros((3, n))
    for e in range(ends):
        reached, at = np.full(n, sizes[about[e]]), np.zeros(3)
        for axis in range(d):
            for j in range(len(z)):
                at[axis] += ways[e, axis, j] * z[j]
            for i in range(n):
                a[axis, i] = normals[i, period[e], axis]
                reached[i] += a[axis, i] * at[axis]
        for k in range(used.shape[1]):
            span, size = np.zeros(3), sizes[used[e, k]]
            for axis in range(d):
                span[axis] = spans[e, axis, k]
            u, v, w = span[0], span[1], span[2]
            for i in range(n):
                reached[i] += abs(a[0, i] * u + a[1, i] * v + a[2, i] * w) * size
        for i in range(n):
            left[i, e] = offsets[i, period[e]] - reached[i]
    return left.ravel()


@compiled("f8(f8[::1], f8)")
def least(left: Array, most: float) -> float:
    """The least of all (r,), so much at the most; no number where one of them is none."""
    found, numbers = most, True
    for row in range(len(left)):
        found = left[row] if left[row] < found else found
        numbers &= left[row] == left[row]
    return found if numbers else np.nan


@compiled(
    "Tuple((i8, f8[:,::1], f8[::1]))"
    "(f8[:,::1], f8[:,::1], f8[::1], f8[::1], f8[::1], f8[:,::1], f8[::1], f8[::1], f8[:,::1], f8[::1], f8)"
)
def presolve_rows(
    gradient: Array,
    spread: Array,
    bound: Array,
    z_0: Array,
    constant: Array,
    M: Array,
    center: Array,
    radius: Array,
    atoms: Array,
    scale: Array,
    sharpen: float,
) -> tuple[int, Array, Array]:
    """Rows `gradient z + spread (constant + M t) <= bound - sharpen`, of which the first regressors z_0 are known, as
    those of the rest f and of t, times their scale and of unit length: (count, A, b), of which the first so many matter
    to an f within `radius` of the center and a t within `atoms` (2, q). -1: one of them can't be met."""
    known, free, q = len(z_0), len(center), M.shape[1]
    A, b, count = np.empty((len(bound), free + q)), np.empty(len(bound)), 0
    for r in range(len(bound)):
        row, left = A[count], bound[r] - sharpen
        for j in range(known):
            left -= gradient[r, j] * z_0[j]
        least, most = 0.0, 0.0
        for j in range(free):
            row[j] = gradient[r, known + j]
            least += row[j] * center[j] - abs(row[j]) * radius[j]
            most += row[j] * center[j] + abs(row[j]) * radius[j]
        row[free:] = 0.0
        for k in range(len(constant)):
            share = spread[r, k]
            if share != 0.0:  # most generators are other periods'
                left -= share * constant[k]
                for j in range(q):
                    row[free + j] += share * M[k, j]
        for j in range(q):
            least += row[free + j] * atoms[0, j]
            most += row[free + j] * atoms[1, j]
        if least > left:
            return -1, A, b
        if most > left:
            square = 0.0
            for j in range(free + q):
                row[j] *= scale[j]
                square += row[j] * row[j]
            length = max(np.sqrt(square), sharpen)
            for j in range(free + q):
                row[j] /= length
            b[count] = left / length
            count += 1
    return count, A, b


@compiled("Tuple((f8[::1], f8[::1]))(f8[::1], f8[::1], f8[:,::1], f8[::1])")
def reachable(low: Array, high: Array, way: Array, before: Array) -> tuple[Array, Array]:
    """Center and half-widths (F·m,) of inputs between low and high (m,), no farther from the one before (m,) than so
    much (F, m)."""
    F, m = way.shape
    center, radius = np.empty(F * m), np.empty(F * m)
    for k in range(F):
        for i in range(m):
            least, most = before[i] - way[k, i], before[i] + way[k, i]
            least, most = least if least > low[i] else low[i], most if most < high[i] else high[i]
            center[k * m + i], radius[k * m + i] = 0.5 * (least + most), 0.5 * (most - least)
    return center, radius


@compiled(
    "f8[:,:,::1](f8[:,::1], f8[:,::1], f8[:,::1], f8[::1], f8[:,:,::1], f8[:,:,::1], f8[:,:,::1], f8[::1], f8[::1],"
    " f8[::1], f8[::1], f8[:,::1])"
)
def filled_by_plans(
    W: Array,
    W_free: Array,
    M: Array,
    m_0: Array,
    position: Array,
    moved: Array,
    spans: Array,
    z: Array,
    radius: Array,
    beside: Array,
    start: Array,
    turn: Array,
) -> Array:
    """The corners (2, N+1, d), world, of boxes about all that may be reached at the ends of the periods, and now, of a
    tube (W, M, m_0, position, and its directions' and W's free columns' absolute values) by inputs within so much of
    those in z, and beside (d,) of it."""
    (N, d, L), q = spans.shape, len(W)
    atoms, sizes = np.empty(q), m_0.copy()
    for i in range(q):
        center, give = 0.0, 0.0
        for j in range(len(z)):
            center += W[i, j] * z[j]
        for j in range(len(radius)):
            give += W_free[i, j] * radius[j]
        atoms[i] = abs(center) + give
    for k in range(len(sizes)):
        for i in range(q):
            sizes[k] += M[k, i] * atoms[i]
    chord_deviation = sizes[L:].max()
    way, half, boxes = np.empty(d), np.empty(d), np.zeros((2, N + 1, d))
    for k in range(N):
        for axis in range(d):
            way[axis], half[axis] = 0.0, beside[axis] + chord_deviation
            for j in range(len(z)):
                way[axis] += position[k, axis, j] * z[j]
            for j in range(len(radius)):
                half[axis] += moved[k, axis, j] * radius[j]
            for j in range(L):
                half[axis] += spans[k, axis, j] * sizes[j]
        for axis in range(d):
            middle, aside = start[axis], 0.0
            for other in range(d):
                middle += turn[axis, other] * way[other]
                aside += abs(turn[axis, other]) * half[other]
            boxes[0, k + 1, axis], boxes[1, k + 1, axis] = middle - aside, middle + aside
            if k == 0:
                boxes[0, 0, axis], boxes[1, 0, axis] = start[axis] - aside, start[axis] + aside
    return boxes

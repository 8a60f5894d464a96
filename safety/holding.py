"""Half-spaces held against the ends of a tube, compiled: as rows, and what is left of them (`program.Layout`).

Of E ends each has the half-spaces of one period (E,); the ways (E, d, nz) that regressors lead there; K generators,
their directions (E, d, K) and which of all they are (E, K); and one magnitude (E,) that adds to it on all sides.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from messaging.compiled import compiled

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

"""Where a tube and its first step lead under regressors z, compiled; what they are say `tube.py`, `certificates.py`.

W (q, nz), M (K, q) and kappa (g, nz) are told transposed: so many sums are made at a time, each in its own order.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from brakeline.safety.compilation import compiled

Array = NDArray[np.float64]


@compiled("b1(f8[::1], f8[:,::1])")
def within(values: Array, bounds: Array) -> bool:
    """Are the first values, as many as there are bounds (2, k), within them? One that is no number is not."""
    found = True
    for i in range(bounds.shape[1]):
        found &= bounds[0, i] <= values[i] <= bounds[1, i]
    return found


@compiled("void(f8[:,::1], f8[::1], f8[::1])")
def _add_product(A: Array, x: Array, found: Array) -> None:
    """A's transpose (n, k) times x (n,), added to what is found (k,)."""
    for i in range(len(x)):
        row, share = A[i], x[i]
        for k in range(len(found)):
            found[k] += row[k] * share


@compiled("f8[::1](f8[:,::1], f8[:,::1], f8[::1], f8[::1])")
def magnitudes(W: Array, M: Array, m_0: Array, z: Array) -> Array:
    """Lengths (K,) of what a tube's sets are made of: M |W z| + m_0."""
    atoms, sizes = np.zeros(W.shape[1]), m_0.copy()
    _add_product(W, z, atoms)
    _add_product(M, np.abs(atoms), sizes)
    return sizes


@compiled("f8[:,::1](f8[:,:,::1], f8[::1], f8[::1], f8[:,::1])")
def places(position: Array, z: Array, start: Array, turn: Array) -> Array:
    """Nominal ends of the periods (N, d), world, from a start (d,) turned by (d, d)."""
    (N, d, nz), way = position.shape, np.empty(position.shape[1])
    found = np.empty((N, d))
    for k in range(N):
        for axis in range(d):
            way[axis] = 0.0
            for j in range(nz):
                way[axis] += position[k, axis, j] * z[j]
        for axis in range(d):
            found[k, axis] = start[axis]
            for other in range(d):
                found[k, axis] += turn[axis, other] * way[other]
    return found


@compiled(
    "Tuple((f8[:,::1], f8[:,::1]))"
    "(f8[:,::1], f8[:,::1], f8[::1], f8[:,:,::1], f8[:,:,::1], f8[::1], f8[::1], f8[:,::1], f8[::1])"
)
def sets(
    W: Array,
    M: Array,
    m_0: Array,
    position: Array,
    directions: Array,
    z: Array,
    start: Array,
    turn: Array,
    measured: Array,
) -> tuple[Array, Array]:
    """Centers and half-widths (N, d), world, of boxes about a tube's positions at the periods' ends, from a start (d,)
    turned by (d, d), and whatever is measured (d,) beside it."""
    (N, d, L), sizes = directions.shape, magnitudes(W, M, m_0, z)
    half, along = np.empty((N, d)), np.empty(L)
    for k in range(N):
        for axis in range(d):
            half[k, axis], along[:] = measured[axis], 0.0
            for other in range(d):
                part, span = turn[axis, other], directions[k, other]
                for i in range(L):
                    along[i] += part * span[i]
            for i in range(L):
                half[k, axis] += abs(along[i]) * sizes[i]
    return places(position, z, start, turn), half


@compiled("f8(f8[:,::1], f8[:,::1], f8[::1], f8[:,:,::1], f8[:,:,::1], f8[::1], f8)")
def extent(W: Array, M: Array, m_0: Array, position: Array, directions: Array, z: Array, body: float) -> float:
    """How far [m] from the start any point of a body may be that is so large, anywhere in a tube."""
    (N, d, L), sizes, farthest = directions.shape, magnitudes(W, M, m_0, z), 0.0
    for k in range(N):
        square = 0.0
        for axis in range(d):
            way, aside = 0.0, 0.0
            for j in range(len(z)):
                way += position[k, axis, j] * z[j]
            for i in range(L):
                aside += abs(directions[k, axis, i]) * sizes[i]
            square += (abs(way) + aside) ** 2
        farthest = max(farthest, square)
    return math.sqrt(farthest) + body + float(sizes[L:].max())


@compiled(
    "Tuple((f8[::1], f8[::1]))"
    "(f8[:,::1], f8[:,::1], f8[:,::1], f8[:,::1], f8[::1], f8[:,::1], f8[::1], f8[::1], f8[:,::1])"
)
def next_state(
    C: Array, W: Array, M: Array, kappa: Array, w: Array, widths: Array, z: Array, start: Array, turn: Array
) -> tuple[Array, Array]:
    """Center and half-widths (n,) of the next state under a certificate (C as it is, and its generators' absolute
    values), its position from a start (d,), turned by (d, d)."""
    n, d, sizes = len(C), len(start), magnitudes(W, M, w, z)
    _add_product(kappa, np.abs(z), sizes)
    center, half, moved = np.zeros(n), np.zeros(n), np.zeros(d)
    for i in range(n):
        for j in range(len(z)):
            center[i] += C[i, j] * z[j]
        for j in range(len(sizes)):
            half[i] += widths[i, j] * sizes[j]
    for axis in range(d):
        for other in range(d):
            moved[axis] += turn[axis, other] * center[other]
    center[:d] = start + moved
    return center, half

"""Compiled loops over a tube and its predicted set (docs/method.md §2; see `Tube` and `ErrorBound`).

W_t (nz, q), M_t (q, K) and kappa_t (nz, g) are the transposes of W, M and kappa: so the innermost loops run along
contiguous rows. start (d,) is the measured position, turn (d, d) the rotation from the robot's frame to the world.

`tests/safety/kernel_twins.py` has each function in plain NumPy.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from brakeline.compilation import compiled

Array = NDArray[np.float64]


@compiled("b1(f8[::1], f8[:,::1])")
def within(values: Array, bounds: Array) -> bool:
    """Return whether the first k values lie within bounds (2, k). NaN does not."""
    inside = True
    for i in range(bounds.shape[1]):
        inside &= bounds[0, i] <= values[i] <= bounds[1, i]
    return inside


@compiled("void(f8[:,::1], f8[::1], f8[::1])")
def _add_product(A_t: Array, x: Array, total: Array) -> None:
    """Add A x to `total` (k,), with A_t (n, k) and x (n,)."""
    for i in range(len(x)):
        column, factor = A_t[i], x[i]
        for k in range(len(total)):
            total[k] += column[k] * factor


@compiled("f8[::1](f8[:,::1], f8[:,::1], f8[::1], f8[::1])")
def magnitudes(W_t: Array, M_t: Array, m_0: Array, z: Array) -> Array:
    """Return m(z) = M |W z| + m_0 (K,)."""
    atoms, sizes = np.zeros(W_t.shape[1]), m_0.copy()
    _add_product(W_t, z, atoms)
    _add_product(M_t, np.abs(atoms), sizes)
    return sizes


@compiled("f8[:,::1](f8[:,:,::1], f8[:,:], f8[::1], f8[::1], f8[:,::1])")
def places(position: Array, offset: Array, z: Array, start: Array, turn: Array) -> Array:
    """Return the nominal positions (N, d) at the periods' ends, world: start + turn (P_i z + c_i)."""
    (N, d, nz), moved = position.shape, np.empty(position.shape[1])
    nominal = np.empty((N, d))
    for k in range(N):
        for axis in range(d):
            moved[axis] = offset[k, axis]
            for j in range(nz):
                moved[axis] += position[k, axis, j] * z[j]
        for axis in range(d):
            nominal[k, axis] = start[axis]
            for other in range(d):
                nominal[k, axis] += turn[axis, other] * moved[other]
    return nominal


@compiled(
    "Tuple((f8[:,::1], f8[:,::1]))"
    "(f8[:,::1], f8[:,::1], f8[::1], f8[:,:,::1], f8[:,:], f8[:,:,::1], f8, f8[::1], f8[::1], f8[:,::1], f8[::1])"
)
def sets(
    W_t: Array,
    M_t: Array,
    m_0: Array,
    position: Array,
    offset: Array,
    directions: Array,
    widening: float,
    z: Array,
    start: Array,
    turn: Array,
    measured: Array,
) -> tuple[Array, Array]:
    """Return centers and half-widths (N, d), world, of boxes that contain the true positions at the periods' ends.

    measured (d,): half-widths of the position's measurement error. widening: factor on the tube's sets.
    """
    (N, d, L), sizes = directions.shape, magnitudes(W_t, M_t, m_0, z)
    half, along = np.empty((N, d)), np.empty(L)
    for k in range(N):
        for axis in range(d):
            half[k, axis], along[:] = measured[axis], 0.0
            for other in range(d):
                part, span = turn[axis, other], directions[k, other]
                for i in range(L):
                    along[i] += part * span[i]
            for i in range(L):
                half[k, axis] += abs(along[i]) * sizes[i] * widening
    return places(position, offset, z, start, turn), half


@compiled("f8(f8[:,::1], f8[:,::1], f8[::1], f8[:,:,::1], f8[:,:], f8[:,:,::1], f8, f8[::1], f8)")
def extent(
    W_t: Array,
    M_t: Array,
    m_0: Array,
    position: Array,
    offset: Array,
    directions: Array,
    widening: float,
    z: Array,
    body: float,
) -> float:
    """Return the distance [m] from the start that no point of a body of radius `body` [m] exceeds in the tube."""
    (N, d, L), sizes, farthest = directions.shape, magnitudes(W_t, M_t, m_0, z), 0.0
    for k in range(N):
        square = 0.0
        for axis in range(d):
            moved, width = offset[k, axis], 0.0
            for j in range(position.shape[2]):
                moved += position[k, axis, j] * z[j]
            for i in range(L):
                width += abs(directions[k, axis, i]) * sizes[i]
            square += (abs(moved) + widening * width) ** 2
        farthest = max(farthest, square)
    return math.sqrt(farthest) + body + widening * float(sizes[L:].max())


@compiled(
    "Tuple((f8[::1], f8[::1]))"
    "(f8[:,::1], f8[:,::1], f8[:,::1], f8[:,::1], f8[::1], f8[:,::1], f8[::1], f8[::1], f8[::1], f8[::1], f8[:,::1])"
)
def next_state(
    C: Array,
    W_t: Array,
    M_t: Array,
    kappa_t: Array,
    w: Array,
    widths: Array,
    z: Array,
    first: Array,
    widening: Array,
    start: Array,
    turn: Array,
) -> tuple[Array, Array]:
    """Return center and half-widths (n,) of the predicted set: bound (1) for one period, position in the world.

    C (n, nz), W, M, kappa, w (g,): of the error bound; widths (n, g): absolute values of its generators. first (n,):
    prediction of a predictor that is not linear, or zeros. widening (n,): factors on the half-widths.
    """
    n, d, sizes = len(C), len(start), magnitudes(W_t, M_t, w, z)
    _add_product(kappa_t, np.abs(z), sizes)
    center, half, moved = np.zeros(n), np.zeros(n), np.zeros(d)
    for i in range(n):
        center[i] = first[i]
        for j in range(len(z)):
            center[i] += C[i, j] * z[j]
        for j in range(len(sizes)):
            half[i] += widths[i, j] * sizes[j] * widening[i]
    for axis in range(d):
        for other in range(d):
            moved[axis] += turn[axis, other] * center[other]
    center[:d] = start + moved
    return center, half

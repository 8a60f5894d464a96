"""Compiled rollout of a one-step predictor, with its gradient (docs/method.md §13; see `OneStep`).

The parts of the predictor, and what else the functions share:

    C (n, F)            outputs of one period, from the features φ
    scale (v,)          units of the variables v = [s; u; input of the period before]
    saturations (E, 3)  [a, b, width]: further primitives tanh((v_a - v_b) / width), with b = -1 for no v_b
    terms (F, 4)        feature f is the product of the primitives p[terms[f]], p = [1; v / scale; saturations]
    others (r,)         indices in the state of the coordinates s, which are neither position nor heading
    heading             index of the heading in the state, -1 without one
    arms (D, d)         centers of the body's further discs, in the robot's frame
    d, inputs           numbers of position coordinates and of inputs
    across (F, F)       transposed root: the inverse of the lower Cholesky factor of the features' second moment
    weight              how much the sets grow with the leverage

`tests/safety/kernel_twins.py` has each function in plain NumPy.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from brakeline.compilation import compiled
from brakeline.safety.model.one_step import Predictor

Array = NDArray[np.float64]
Index = NDArray[np.int64]

PREDICTOR = "Tuple((f8[:,::1], f8[::1], f8[:,::1], i8[:,::1], i8[::1], i8, f8[:,::1], i8, i8))"  # its type for Numba


@compiled("void(f8[:,::1], f8[::1], f8[:,::1], i8[:,::1], f8[::1], f8[::1], f8[::1], f8[::1])")
def _predict(
    C: Array, scale: Array, saturations: Array, terms: Index, v: Array, p: Array, total: Array, y: Array
) -> None:
    """Write the primitives of the variables v into p and the outputs C φ into y (n,); add φ to total (F,)."""
    p[0], y[:] = 1.0, 0.0
    for i in range(len(v)):
        p[1 + i] = v[i] / scale[i]
    for e in range(len(saturations)):
        a, b = int(saturations[e, 0]), int(saturations[e, 1])
        away = v[a] - v[b] if b >= 0 else v[a]
        p[1 + len(v) + e] = math.tanh(away / saturations[e, 2])
    for f in range(len(terms)):
        feature = p[terms[f, 0]] * p[terms[f, 1]] * p[terms[f, 2]] * p[terms[f, 3]]
        total[f] += feature
        for i in range(len(y)):
            y[i] += C[i, f] * feature


@compiled("void(f8[:,::1], f8[::1], f8[:,::1], i8[:,::1], f8[::1], f8[:,::1])")
def _partials(C: Array, scale: Array, saturations: Array, terms: Index, p: Array, partial: Array) -> None:
    """Write the derivatives of the outputs by the variables into `partial` (n, v), from the primitives p."""
    n, V = partial.shape
    slopes = np.zeros((n, len(p)))
    for f in range(len(terms)):
        for slot in range(4):
            of = terms[f, slot]
            if of > 0:
                rest = p[terms[f, (slot + 1) % 4]] * p[terms[f, (slot + 2) % 4]] * p[terms[f, (slot + 3) % 4]]
                for i in range(n):
                    slopes[i, of] += C[i, f] * rest
    for i in range(n):
        for j in range(V):
            partial[i, j] = slopes[i, 1 + j] / scale[j]
        for e in range(len(saturations)):
            a, b, bent = int(saturations[e, 0]), int(saturations[e, 1]), p[1 + V + e]
            slope = slopes[i, 1 + V + e] * (1.0 - bent * bent) / saturations[e, 2]
            partial[i, a] += slope
            if b >= 0:
                partial[i, b] -= slope


@compiled("void(f8[:,::1], f8[:,::1], f8[:,::1])")
def _product(partial: Array, dv: Array, dy: Array) -> None:
    """Write partial dv (n, nz) into dy."""
    dy[:] = 0.0
    for i in range(partial.shape[0]):
        for j in range(partial.shape[1]):
            if partial[i, j] != 0.0:
                for c in range(dv.shape[1]):
                    dy[i, c] += partial[i, j] * dv[j, c]


@compiled("void(f8[::1], f8[:,::1], f8[::1], f8[:,::1], i8)")
def _move(y: Array, dy: Array, pose: Array, dpose: Array, heading: int) -> None:
    """Move the pose [angle; position] (1 + d,) and its gradient by the outputs y of a period in the robot's frame."""
    nz, straight = dy.shape[1], 0
    if heading >= 0:
        cos, sin, straight = math.cos(pose[0]), math.sin(pose[0]), 2
        east, north = cos * y[0] - sin * y[1], sin * y[0] + cos * y[1]
        for c in range(nz):
            dpose[1, c] += cos * dy[0, c] - sin * dy[1, c] - north * dpose[0, c]
            dpose[2, c] += sin * dy[0, c] + cos * dy[1, c] + east * dpose[0, c]
            dpose[0, c] += dy[heading, c]
        pose[1] += east
        pose[2] += north
        pose[0] += y[heading]
    for axis in range(straight, len(pose) - 1):
        pose[1 + axis] += y[axis]
        for c in range(nz):
            dpose[1 + axis, c] += dy[axis, c]


@compiled("void(f8[::1], f8[:,::1], f8[::1], f8[:,::1], i8[::1], i8, f8[:,::1], f8[::1], f8[:,::1])")
def _write(
    y: Array,
    dy: Array,
    pose: Array,
    dpose: Array,
    others: Index,
    heading: int,
    arms: Array,
    row: Array,
    slope: Array,
) -> None:
    """Write the outputs after a period into `row` (n + D·d,) and their gradient into `slope` (n + D·d, nz)."""
    d, nz = len(pose) - 1, dy.shape[1]
    for i in range(len(others)):
        row[others[i]], slope[others[i]] = y[others[i]], dy[others[i]]
    for axis in range(d):
        row[axis], slope[axis] = pose[1 + axis], dpose[1 + axis]
    if heading >= 0:
        row[heading], slope[heading] = pose[0], dpose[0]
        cos, sin = math.cos(pose[0]), math.sin(pose[0])
        for j in range(len(arms)):
            at = len(y) + j * d
            for axis in range(d):
                row[at + axis], slope[at + axis] = pose[1 + axis], dpose[1 + axis]
            east, north = cos * arms[j, 0] - sin * arms[j, 1], sin * arms[j, 0] + cos * arms[j, 1]
            row[at] += east - arms[j, 0]
            row[at + 1] += north - arms[j, 1]
            for c in range(nz):
                slope[at, c] -= north * dpose[0, c]
                slope[at + 1, c] += east * dpose[0, c]


@compiled("f8[::1](f8[:,::1], f8[:,::1])")
def _squares(across: Array, totals: Array) -> Array:
    """Return |root total|² (N,) for sums of features `totals` (N, F).

    The loop over the periods is not the outer one, so that each column of the root is read once from memory.
    """
    N, F = totals.shape
    along, squares = np.zeros((N, F)), np.zeros(N)
    for j in range(F):
        column = across[j, j:]
        for k in range(N):
            sums = along[k, j:]
            for i in range(len(column)):
                sums[i] += column[i] * totals[k, j]
    for k in range(N):
        for i in range(F):
            squares[k] += along[k, i] * along[k, i]
    return squares


@compiled(f"Tuple((f8[:,::1], f8[::1]))({PREDICTOR}, f8[:,::1], f8, f8[::1])")
def rollout(predictor: Predictor, across: Array, weight: float, z: Array) -> tuple[Array, Array]:
    """Return the outputs after each period, in the frame of the start, and the factors on the sets around them.

    The outputs (N, n + D·d) are the displacement, the change of heading and the other coordinates, as in `Windows.y`,
    then the displacements of the discs at `arms`. The factors (N,) are sqrt(1 + weight h_k), where
    h_k = |root Σ_{j<k} φ_j|² / k is the leverage of the first k periods (docs/method.md §14).

    Args:
        z (r + m + N·m,): the window.
    """
    C, scale, saturations, terms, others, heading, arms, d, inputs = predictor
    n, r, F = len(C), len(others), len(terms)
    N = (len(z) - r) // inputs - 1
    outputs, v, y = np.zeros((N, n + len(arms) * d)), np.empty(r + 2 * inputs), np.empty(n)
    p, total, totals = np.empty(1 + len(v) + len(saturations)), np.zeros(F), np.empty((N, F))
    pose, flat = np.zeros(1 + d), np.empty((outputs.shape[1], 0))  # no gradient
    v[:r] = z[:r]
    for k in range(N):
        now = r + (k + 1) * inputs
        v[r : r + inputs], v[r + inputs :] = z[now : now + inputs], z[now - inputs : now]
        _predict(C, scale, saturations, terms, v, p, total, y)
        totals[k] = total
        _move(y, flat[:n], pose, flat[: 1 + d], heading)
        _write(y, flat[:n], pose, flat[: 1 + d], others, heading, arms, outputs[k], flat)
        for i in range(r):
            v[i] = y[others[i]]
    return outputs, np.sqrt(1.0 + weight * (_squares(across, totals) / np.arange(1, N + 1)))


@compiled("f8[::1](f8[:,::1], f8[::1])")
def _window_of(T: Array, z: Array) -> Array:
    """Return the window T z, summed in the order of the columns."""
    window = np.zeros(len(T))
    for i in range(len(T)):
        for j in range(len(z)):
            window[i] += T[i, j] * z[j]
    return window


@compiled(f"Tuple((f8[:,::1], f8[:,:,::1]))({PREDICTOR}, f8[::1], f8[:,::1])")
def linearized(predictor: Predictor, z: Array, T: Array) -> tuple[Array, Array]:
    """Return the outputs (N, n + D·d) of a window z (r + m + N·m,), and their gradient (N, n + D·d, c).

    T (r + m + N·m, c): how the window changes with the c numbers for which the gradient is wanted.
    """
    C, scale, saturations, terms, others, heading, arms, d, inputs = predictor
    n, r, nz = len(C), len(others), T.shape[1]
    N, V = (len(z) - r) // inputs - 1, r + 2 * inputs
    outputs, gradient = np.zeros((N, n + len(arms) * d)), np.zeros((N, n + len(arms) * d, nz))
    v, y, p, total = np.empty(V), np.empty(n), np.empty(1 + V + len(saturations)), np.zeros(len(terms))
    partial, dv, dy = np.empty((n, V)), np.zeros((V, nz)), np.empty((n, nz))
    pose, dpose = np.zeros(1 + d), np.zeros((1 + d, nz))
    v[:r], dv[:r] = z[:r], T[:r]
    for k in range(N):
        now = r + (k + 1) * inputs
        v[r : r + inputs], v[r + inputs :] = z[now : now + inputs], z[now - inputs : now]
        dv[r : r + inputs], dv[r + inputs :] = T[now : now + inputs], T[now - inputs : now]
        _predict(C, scale, saturations, terms, v, p, total, y)
        _partials(C, scale, saturations, terms, p, partial)
        _product(partial, dv, dy)
        _move(y, dy, pose, dpose, heading)
        _write(y, dy, pose, dpose, others, heading, arms, outputs[k], gradient[k])
        for i in range(r):
            v[i], dv[i] = y[others[i]], dy[others[i]]
    return outputs, gradient


@compiled(f"Tuple((f8[:,:,::1], f8[:,::1], f8[:,:,::1], f8[:,::1]))({PREDICTOR}, f8[::1], f8[:,::1], i8[::1])")
def affine(predictor: Predictor, z: Array, T: Array, further: Index) -> tuple[Array, Array, Array, Array]:
    """Return the rollout as affine maps of z that are exact at z, for the positions and the coordinates `further` (k,).

    T (r + m + N·m, nz): the map from z to a window, which holds all inputs.

    Returns:
        Gradient (N, d, nz) and offset (N, d) of the positions, and the same of the further coordinates.
    """
    outputs, gradient = linearized(predictor, _window_of(T, z), T)
    N, nz, k, d = len(outputs), len(z), len(further), predictor[7]
    position, offset = np.empty((N, d, nz)), np.empty((N, d))
    more, more_offset = np.empty((N, k, nz)), np.empty((N, k))
    for i in range(N):
        for axis in range(d + k):
            at = axis if axis < d else further[axis - d]
            rest = outputs[i, at]
            for j in range(nz):
                rest -= gradient[i, at, j] * z[j]
            if axis < d:
                position[i, axis], offset[i, axis] = gradient[i, at], rest
            else:
                more[i, axis - d], more_offset[i, axis - d] = gradient[i, at], rest
    return position, offset, more, more_offset


@compiled(
    "Tuple((f8[:,::1], f8[:,:,::1], f8[:,::1], f8[:,:,::1], f8[::1], f8[::1]))"
    f"({PREDICTOR}, f8[:,::1], f8,"
    " f8[:,::1], i8[::1], f8[:,:,::1], f8[:,:,::1], f8[::1])"
)
def sets_around(
    predictor: Predictor,
    across: Array,
    weight: float,
    T: Array,
    further: Index,
    directions: Array,
    more_directions: Array,
    z: Array,
) -> tuple[Array, Array, Array, Array, Array, Array]:
    """Return the rollout from z, and the generators of the sets around it.

    directions (N, d, L), more_directions (N, k, L): without the factors, for the positions and the coordinates
    `further`.

    Returns:
        Positions (N, d) and their generators (N, d, L), the same of the further coordinates, all coordinates after one
        period (n,), and the factors (N,) that the generators hold.
    """
    outputs, wider = rollout(predictor, across, weight, _window_of(T, z))
    (N, d, _), k = directions.shape, len(further)
    centers, wide, more, more_wide = (
        np.empty((N, d)),
        np.empty_like(directions),
        np.empty((N, k)),
        more_directions.copy(),
    )
    for i in range(N):
        for axis in range(d):
            centers[i, axis], wide[i, axis] = outputs[i, axis], wider[i] * directions[i, axis]
        for axis in range(k):
            more[i, axis] = outputs[i, further[axis]]
        more_wide[i] *= wider[i]
    return centers, wide, more, more_wide, outputs[0, : len(predictor[0])].copy(), wider

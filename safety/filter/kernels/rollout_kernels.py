"""Compiled rollout of a one-step predictor, with its gradient (docs/method.md §13; see `OneStep`).

Arguments that all functions share:

    C (n, F)            outputs of one period, from the features φ
    scale (v,)          units of the variables v = [s; u; input of the period before]
    saturations (E, 3)  [a, b, width]: further primitives tanh((v_a - v_b) / width), with b = -1 for no v_b
    terms (F, 3)        feature f is the product of the primitives p[terms[f]], p = [1; v / scale; saturations]
    others (r,)         indices in the state of the coordinates s, which are neither position nor heading
    heading             index of the heading in the state, -1 without one
    arms (D, d)         centers of the body's further discs, in the robot's frame

`tests/safety/kernel_twins.py` has each function in plain NumPy.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from brakeline.safety.compilation import compiled

Array = NDArray[np.float64]
Index = NDArray[np.int64]


@compiled("void(f8[::1], f8[:,::1], f8[::1], f8[::1])")
def _primitives(scale: Array, saturations: Array, v: Array, p: Array) -> None:
    """Write the primitives of the variables v into p (1 + v + E,)."""
    p[0] = 1.0
    for i in range(len(v)):
        p[1 + i] = v[i] / scale[i]
    for e in range(len(saturations)):
        a, b = int(saturations[e, 0]), int(saturations[e, 1])
        away = v[a] - v[b] if b >= 0 else v[a]
        p[1 + len(v) + e] = math.tanh(away / saturations[e, 2])


@compiled("void(f8[:,::1], f8[:,::1], i8[:,::1], f8[::1], f8[::1])")
def _outputs(C: Array, saturations: Array, terms: Index, p: Array, y: Array) -> None:
    """Write the outputs C φ into y (n,)."""
    y[:] = 0.0
    for f in range(len(terms)):
        feature = p[terms[f, 0]] * p[terms[f, 1]] * p[terms[f, 2]]
        for i in range(len(y)):
            y[i] += C[i, f] * feature


@compiled("f8[:,:,::1](f8[:,::1], f8[::1], f8[:,::1], i8[:,::1], i8[::1], i8, f8[:,::1], i8, i8, f8[:,::1])")
def rollouts(
    C: Array,
    scale: Array,
    saturations: Array,
    terms: Index,
    others: Index,
    heading: int,
    arms: Array,
    d: int,
    inputs: int,
    z: Array,
) -> Array:
    """Return the outputs (T, N, n + D·d) after each period, in the frame of the start, for windows z (T, r + m + N·m).

    The outputs are the displacement, the change of heading and the other coordinates, as in `Windows.y`, then the
    displacements of the discs at `arms`.
    """
    n, r, D = len(C), len(others), len(arms)
    N = (z.shape[1] - r) // inputs - 1
    found, v, y = np.zeros((len(z), N, n + D * d)), np.empty(r + 2 * inputs), np.empty(n)
    p = np.empty(1 + len(v) + len(saturations))
    for t in range(len(z)):
        cos, sin, angle = 1.0, 0.0, 0.0
        at = np.zeros(d)
        for i in range(r):
            v[i] = z[t, i]
        for k in range(N):
            for i in range(inputs):
                v[r + i] = z[t, r + (k + 1) * inputs + i]
                v[r + inputs + i] = z[t, r + k * inputs + i]
            _primitives(scale, saturations, v, p)
            _outputs(C, saturations, terms, p, y)
            row = found[t, k]
            for axis in range(d):
                at[axis] += y[axis]
            if heading >= 0:
                at[0] += (cos - 1.0) * y[0] - sin * y[1]
                at[1] += (cos - 1.0) * y[1] + sin * y[0]
                angle += y[heading]
                cos, sin = math.cos(angle), math.sin(angle)
                row[heading] = angle
            for axis in range(d):
                row[axis] = at[axis]
            for i in range(r):
                v[i] = row[others[i]] = y[others[i]]
            for j in range(D):
                for axis in range(d):
                    row[n + j * d + axis] = at[axis]
                row[n + j * d] += (cos - 1.0) * arms[j, 0] - sin * arms[j, 1]
                row[n + j * d + 1] += (cos - 1.0) * arms[j, 1] + sin * arms[j, 0]
    return found


@compiled("f8[:,::1](f8[:,::1], f8[::1], f8[:,::1], i8[:,::1], i8[::1], i8, f8[:,::1], i8, i8, f8[:,::1], f8[:,::1])")
def leverages(
    C: Array,
    scale: Array,
    saturations: Array,
    terms: Index,
    others: Index,
    heading: int,
    arms: Array,
    d: int,
    inputs: int,
    root: Array,
    z: Array,
) -> Array:
    """Return the leverages h_k (T, N) of the first k periods of windows z (T, r + m + N·m): |root Σ_{j<k} φ_j|² / k.

    root (F, F): inverse of the lower Cholesky factor of the features' second moment.
    """
    r, F = len(others), len(terms)
    N = (z.shape[1] - r) // inputs - 1
    found, v, y = np.zeros((len(z), N)), np.empty(r + 2 * inputs), np.empty(len(C))
    p, total = np.empty(1 + len(v) + len(saturations)), np.empty(F)
    for t in range(len(z)):
        total[:] = 0.0
        v[:r] = z[t, :r]
        for k in range(N):
            for i in range(inputs):
                v[r + i] = z[t, r + (k + 1) * inputs + i]
                v[r + inputs + i] = z[t, r + k * inputs + i]
            _primitives(scale, saturations, v, p)
            _outputs(C, saturations, terms, p, y)
            for f in range(F):
                total[f] += p[terms[f, 0]] * p[terms[f, 1]] * p[terms[f, 2]]
            square = 0.0
            for i in range(F):
                along = 0.0
                for j in range(i + 1):
                    along += root[i, j] * total[j]
                square += along * along
            found[t, k] = square / (k + 1)
            for i in range(r):
                v[i] = y[others[i]]
    return found


@compiled("void(f8[:,::1], f8[::1], f8[:,::1], i8[:,::1], f8[::1], f8[:,::1])")
def _partials(C: Array, scale: Array, saturations: Array, terms: Index, p: Array, partial: Array) -> None:
    """Write the derivatives of the outputs by the variables into `partial` (n, v), from the primitives p."""
    n, V = partial.shape
    slopes = np.zeros((n, len(p)))
    for f in range(len(terms)):
        for slot in range(3):
            of = terms[f, slot]
            if of > 0:
                rest = p[terms[f, (slot + 1) % 3]] * p[terms[f, (slot + 2) % 3]]
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


@compiled(
    "Tuple((f8[:,::1], f8[:,:,::1]))"
    "(f8[:,::1], f8[::1], f8[:,::1], i8[:,::1], i8[::1], i8, f8[:,::1], i8, i8, f8[::1], f8[:,::1])"
)
def linearized(
    C: Array,
    scale: Array,
    saturations: Array,
    terms: Index,
    others: Index,
    heading: int,
    arms: Array,
    d: int,
    inputs: int,
    z: Array,
    T: Array,
) -> tuple[Array, Array]:
    """Return the outputs (N, n + D·d) for the regressors T z, and their gradient (N, n + D·d, nz) in z (nz,).

    T (r + m + N·m, nz): the map from z to the regressors of a window, which hold all inputs.
    """
    n, r, nz = len(C), len(others), len(z)
    N, V = (len(T) - r) // inputs - 1, r + 2 * inputs
    outputs, gradient = np.zeros((N, n + len(arms) * d)), np.zeros((N, n + len(arms) * d, nz))
    v, y, p = np.empty(V), np.empty(n), np.empty(1 + V + len(saturations))
    known, partial = np.zeros(len(T)), np.empty((n, V))
    dv, dy, pose, dpose = np.zeros((V, nz)), np.empty((n, nz)), np.zeros(1 + d), np.zeros((1 + d, nz))
    for i in range(len(T)):
        for j in range(nz):
            known[i] += T[i, j] * z[j]
    v[:r], dv[:r] = known[:r], T[:r]
    for k in range(N):
        for i in range(inputs):
            now, before = r + (k + 1) * inputs + i, r + k * inputs + i
            v[r + i], v[r + inputs + i] = known[now], known[before]
            dv[r + i], dv[r + inputs + i] = T[now], T[before]
        _primitives(scale, saturations, v, p)
        _outputs(C, saturations, terms, p, y)
        _partials(C, scale, saturations, terms, p, partial)
        _product(partial, dv, dy)
        _move(y, dy, pose, dpose, heading)
        row, slope = outputs[k], gradient[k]
        for i in range(r):
            v[i] = row[others[i]] = y[others[i]]
            dv[i] = slope[others[i]] = dy[others[i]]
        for axis in range(d):
            row[axis], slope[axis] = pose[1 + axis], dpose[1 + axis]
        if heading >= 0:
            row[heading], slope[heading] = pose[0], dpose[0]
        cos, sin = math.cos(pose[0]), math.sin(pose[0])
        for j in range(len(arms)):
            at = n + j * d
            for axis in range(d):
                row[at + axis], slope[at + axis] = pose[1 + axis], dpose[1 + axis]
            east, north = cos * arms[j, 0] - sin * arms[j, 1], sin * arms[j, 0] + cos * arms[j, 1]
            row[at] += east - arms[j, 0]
            row[at + 1] += north - arms[j, 1]
            for c in range(nz):
                slope[at, c] -= north * dpose[0, c]
                slope[at + 1, c] += east * dpose[0, c]
    return outputs, gradient


@compiled(
    "Tuple((f8[:,:,::1], f8[:,::1], f8[:,:,::1], f8[:,::1], f8[::1]))"
    "(f8[:,::1], f8[::1], f8[:,::1], i8[:,::1], i8[::1], i8, f8[:,::1], i8, i8, f8[::1], f8[:,::1], i8[::1])"
)
def affine(
    C: Array,
    scale: Array,
    saturations: Array,
    terms: Index,
    others: Index,
    heading: int,
    arms: Array,
    d: int,
    inputs: int,
    z: Array,
    T: Array,
    kept: Index,
) -> tuple[Array, Array, Array, Array, Array]:
    """Return the rollout as affine maps of z that are exact at z, for the positions and the coordinates `kept` (k,).

    Returns:
        Gradient (N, d, nz) and offset (N, d) of the positions, the same of the kept coordinates, and all coordinates
        after one period (n,).
    """
    outputs, gradient = linearized(C, scale, saturations, terms, others, heading, arms, d, inputs, z, T)
    N, nz, k = len(outputs), len(z), len(kept)
    position, offset = np.empty((N, d, nz)), np.empty((N, d))
    more, more_offset = np.empty((N, k, nz)), np.empty((N, k))
    for i in range(N):
        for axis in range(d + k):
            at = axis if axis < d else kept[axis - d]
            rest = outputs[i, at]
            for j in range(nz):
                rest -= gradient[i, at, j] * z[j]
            if axis < d:
                position[i, axis], offset[i, axis] = gradient[i, at], rest
            else:
                more[i, axis - d], more_offset[i, axis - d] = gradient[i, at], rest
    return position, offset, more, more_offset, outputs[0, : len(C)].copy()

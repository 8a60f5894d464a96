"""Compiled rollouts of a one-step predictor over many windows, to fit and to check it (see `rollout_kernels`).

The inner loops run along a block of windows, so that they are vectorized.
"""

from __future__ import annotations

import math

import numpy as np

from brakeline.compilation import compiled
from brakeline.safety.filter.kernels.rollout_kernels import PREDICTOR, Array, Index, _move, _write
from brakeline.safety.model.one_step import Predictor

BLOCK = 128  # windows at once: few enough for a fast cache


@compiled("void(f8[:,::1], f8[::1], f8[:,::1], i8[:,::1], f8[:,::1], f8[:,::1], f8[:,::1], f8[:,::1])")
def _predict(
    C: Array, scale: Array, saturations: Array, terms: Index, v: Array, p: Array, total: Array, y: Array
) -> None:
    """Write the primitives of B windows into p (P, B) and their outputs into y (n, B); add their φ to total (F, B).

    The sums have the order of those of a single window, so the outputs are the same, bit for bit, if all are finite.
    """
    p[0], y[:] = 1.0, 0.0
    for i in range(len(v)):
        for t in range(v.shape[1]):
            p[1 + i, t] = v[i, t] / scale[i]
    for e in range(len(saturations)):
        a, b = int(saturations[e, 0]), int(saturations[e, 1])
        for t in range(v.shape[1]):
            away = v[a, t] - v[b, t] if b >= 0 else v[a, t]
            p[1 + len(v) + e, t] = math.tanh(away / saturations[e, 2])
    feature = np.empty(v.shape[1])
    for f in range(len(terms)):
        first, second, third, fourth = p[terms[f, 0]], p[terms[f, 1]], p[terms[f, 2]], p[terms[f, 3]]
        sums = total[f]
        if terms[f, 2] == 0 and terms[f, 3] == 0:  # the constant 1
            for t in range(len(feature)):
                feature[t] = first[t] * second[t]
                sums[t] += feature[t]
        else:
            for t in range(len(feature)):
                feature[t] = first[t] * second[t] * third[t] * fourth[t]
                sums[t] += feature[t]
        for i in range(len(y)):
            factor, output = C[i, f], y[i]
            if factor == 0.0:  # most are: an output has features of its own
                continue
            for t in range(len(feature)):
                output[t] += factor * feature[t]


@compiled("void(f8[:,::1], i8, f8[:,::1])")
def _copy_columns(window: Array, first: int, v: Array) -> None:
    """Copy columns of windows (B, r + m + N·m), from the first on, into the rows of v (c, B)."""
    for i in range(len(v)):
        for t in range(len(window)):
            v[i, t] = window[t, first + i]


@compiled("void(f8[:,::1], f8[:,::1], f8, f8[:,::1], i8)")
def _write_factors(root: Array, total: Array, weight: float, factors: Array, k: int) -> None:
    """Write the factors on the sets after period k into column k of factors (B, N), from sums of features (F, B)."""
    along = np.dot(root, total)
    for t in range(len(factors)):
        square = 0.0
        for i in range(len(along)):
            square += along[i, t] * along[i, t]
        factors[t, k] = math.sqrt(1.0 + weight * (square / (k + 1)))


@compiled(f"Tuple((f8[:,:,::1], f8[:,::1]))({PREDICTOR}, f8[:,::1], f8, f8[:,::1], i8)")
def rollouts(predictor: Predictor, root: Array, weight: float, z: Array, first: int) -> tuple[Array, Array]:
    """Return outputs (T, N, n + D·d) and factors (T, N) of windows z (T, r + m + N·m): see `rollout_kernels.rollout`.

    root (F, F): not transposed. With a weight of 0 all factors are 1, and cost nothing. So are those of the periods
    before `first`.
    """
    C, scale, saturations, terms, others, heading, arms, d, inputs = predictor
    n, r, P = len(C), len(others), len(others) + 2 * inputs + len(saturations)
    N = (z.shape[1] - r) // inputs - 1
    outputs, factors, one = np.zeros((len(z), N, n + len(arms) * d)), np.ones((len(z), N)), np.empty(n)
    flat = np.empty((outputs.shape[2], 0))  # no gradient
    for begin in range(0, len(z), BLOCK):
        window = z[begin : begin + BLOCK]
        B = len(window)
        v, y, p = np.empty((r + 2 * inputs, B)), np.empty((n, B)), np.empty((1 + P, B))
        total, pose = np.zeros((len(terms), B)), np.zeros((B, 1 + d))
        _copy_columns(window, 0, v[:r])
        for k in range(N):
            _copy_columns(window, r + (k + 1) * inputs, v[r : r + inputs])
            _copy_columns(window, r + k * inputs, v[r + inputs :])
            _predict(C, scale, saturations, terms, v, p, total, y)
            if weight != 0.0 and k >= first:
                _write_factors(root, total, weight, factors[begin : begin + B], k)
            for t in range(B):
                one[:] = y[:, t]
                _move(one, flat[:n], pose[t], flat[: 1 + d], heading)
                _write(one, flat[:n], pose[t], flat[: 1 + d], others, heading, arms, outputs[begin + t, k], flat)
            for i in range(r):
                v[i] = y[others[i]]
    return outputs, factors

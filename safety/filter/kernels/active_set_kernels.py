"""A compiled guess of the rows of a QP that are active in its solution: Hildreth's dual coordinate ascent (1957)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from brakeline.compilation import compiled

Array = NDArray[np.float64]

LEAST_GAIN = 1e-14  # of the dual objective by one step; with less, the ascent ends


@compiled("b1[::1](f8[::1], f8[::1], f8[:,::1], f8[::1], i8)")
def hildreth_active_set(h: Array, g: Array, A: Array, b: Array, steps: int) -> NDArray[np.bool_]:
    """Return the rows (r,) that `steps` steps of the ascent choose, for `min ½ xᵀ diag(h) x + gᵀ x  s.t.  A x <= b`.

    The ascent starts at the unconstrained solution. Each step changes the multiplier by which the dual gains most. It
    never chooses a row with NaN.
    """
    rows, n = A.shape
    violation, length, multiplier = -b, np.zeros(rows), np.zeros(rows)
    chosen, change = np.zeros(rows, np.bool_), np.empty(n)
    for i in range(rows):
        for j in range(n):
            violation[i] -= A[i, j] * g[j] / h[j]
            length[i] += A[i, j] * A[i, j] / h[j]
    for _ in range(steps):
        best, most_gain, step = -1, LEAST_GAIN, 0.0
        for i in range(rows):
            candidate = max(violation[i] / length[i], -multiplier[i])
            gain = candidate * candidate * length[i]
            if gain > most_gain:  # false for NaN
                best, most_gain, step = i, gain, candidate
        if best < 0:
            break
        chosen[best] = True
        multiplier[best] += step
        for j in range(n):
            change[j] = step * A[best, j] / h[j]
        for i in range(rows):
            for j in range(n):
                violation[i] -= A[i, j] * change[j]
    return chosen

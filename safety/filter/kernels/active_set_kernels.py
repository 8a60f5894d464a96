"""Which rows of a QP decide, compiled: those that coordinate ascent in its dual comes by (Hildreth, 1957)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from brakeline.safety.compilation import compiled

Array = NDArray[np.float64]

LITTLE = 1e-14  # of the objective: who gains no more by a step is there


@compiled("b1[::1](f8[::1], f8[::1], f8[:,::1], f8[::1], i8)")
def hildreth_active_set(h: Array, g: Array, A: Array, b: Array, steps: int) -> NDArray[np.bool_]:
    """Of `min ½ xᵀ diag(h) x + gᵀ x  s.t.  A x <= b`, n unknowns: which rows (r,) so many steps look at, each time the
    one by whose multiplier the dual gains most, from the answer without any."""
    rows, n = A.shape
    left, length, multiplier = -b, np.zeros(rows), np.zeros(rows)
    chosen, away = np.zeros(rows, np.bool_), np.empty(n)
    for i in range(rows):
        for j in range(n):
            left[i] -= A[i, j] * g[j] / h[j]
            length[i] += A[i, j] * A[i, j] / h[j]
    for _ in range(steps):
        best, most, step = -1, LITTLE, 0.0
        for i in range(rows):
            own = max(left[i] / length[i], -multiplier[i])
            gain = own * own * length[i]
            if gain > most:  # not of what is no number
                best, most, step = i, gain, own
        if best < 0:
            break
        chosen[best] = True
        multiplier[best] += step
        for j in range(n):
            away[j] = step * A[best, j] / h[j]
        for i in range(rows):
            for j in range(n):
                left[i] -= A[i, j] * away[j]
    return chosen

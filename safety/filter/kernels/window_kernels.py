"""Compiled score of a window that has ended (docs/method.md §15); arguments as in `rollout_kernels`."""

from __future__ import annotations

import math

import numpy as np

from brakeline.compilation import compiled
from brakeline.safety.filter.kernels.rollout_kernels import PREDICTOR, Array, Index, rollout
from brakeline.safety.model.one_step import Predictor


@compiled(
    f"UniTuple(f8, 2)({PREDICTOR}, f8[:,::1], f8, f8[:,::1], f8[:,::1], f8[:,::1], f8[:,:,::1], f8[:,:,::1], "
    "f8[:,::1], i8[::1])"
)
def score(
    predictor: Predictor,
    across: Array,
    weight: float,
    states: Array,
    executed: Array,
    W: Array,
    M: Array,
    kappa: Array,
    w: Array,
    scored: Index,
) -> tuple[float, float]:
    """Return the largest ratio of an error to its set in a window that has ended; NaN if one is NaN.

    The first number counts all errors, the second only those of the scored coordinates.

    Args:
        states (N + 1, n): measured states. executed (N + 1, m): the input in force before, and the inputs.
        W (q, nz), M (N, c, q), kappa (N, c, nz), w (N, c): the half-widths, M |W z| + kappa |z| + w, of the sets of
            the c = n + D·d outputs of a rollout.
        scored: indices of the coordinates that count after every period. After the first, all count.
    """
    _, _, _, _, others, heading, arms, d, _ = predictor
    r, n = len(others), states.shape[1]
    window = np.empty(r + executed.size)
    for i in range(r):
        window[i] = states[0, others[i]]
    window[r:] = executed.ravel()
    predicted, wider = rollout(predictor, across, weight, window)
    atoms, first, largest, of_scored = np.zeros(len(W)), states[0], 0.0, 0.0
    for i in range(len(W)):
        for j in range(len(window)):
            atoms[i] += W[i, j] * window[j]
    atoms, after = np.abs(atoms), np.empty(w.shape[1])
    cos, sin = (math.cos(first[heading]), math.sin(first[heading])) if heading >= 0 else (1.0, 0.0)
    for k in range(len(w)):
        after[:n] = states[k + 1]
        for axis in range(d):
            after[axis] -= first[axis]
        if heading >= 0:
            east, north = after[0], after[1]
            after[0], after[1] = cos * east + sin * north, cos * north - sin * east
            after[heading] = (after[heading] - first[heading] + math.pi) % math.tau - math.pi
            ahead, aside = math.cos(after[heading]), math.sin(after[heading])
            for j in range(len(arms)):
                at = n + j * d
                after[at : at + d] = after[:d]
                after[at] += ahead * arms[j, 0] - aside * arms[j, 1] - arms[j, 0]
                after[at + 1] += aside * arms[j, 0] + ahead * arms[j, 1] - arms[j, 1]
        for at in range(len(after) if k == 0 else len(scored)):
            i = at if k == 0 else scored[at]
            off, width = abs(after[i] - predicted[k, i]), w[k, i]
            for j in range(len(window)):
                width += kappa[k, i, j] * abs(window[j])
            for j in range(len(atoms)):
                width += M[k, i, j] * atoms[j]
            share = off / (width * wider[k]) if off != 0.0 else 0.0
            if share != share:
                return share, share
            largest = max(largest, share)
            if k > 0 or i in scored:
                of_scored = max(of_scored, share)
    return largest, of_scored

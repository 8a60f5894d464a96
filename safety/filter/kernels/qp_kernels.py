"""Compiled loops that build the QP of a decision (docs/method.md §4; see `qp.QPBuilder`).

Rows (3) are `gradient z + spread m(z) <= bound`, with z = [z_0; f]: known regressors and free inputs.

`tests/safety/kernel_twins.py` has each function in plain NumPy.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from brakeline.compilation import compiled

Array = NDArray[np.float64]


@compiled("f8[::1](f8[:,::1], f8[:,::1], f8[::1], f8[::1], f8[::1])")
def row_slack(gradient: Array, spread: Array, bound: Array, z: Array, sizes: Array) -> Array:
    """Return `bound - gradient z - spread sizes` (rows,). sizes (L+N+1,): the tube's magnitudes m(z)."""
    remaining = bound.copy()
    for r in range(len(bound)):
        for j in range(len(z)):
            remaining[r] -= gradient[r, j] * z[j]
        for k in range(len(sizes)):
            remaining[r] -= spread[r, k] * sizes[k]
    return remaining


@compiled(
    "Tuple((f8[:,::1], f8[:,::1], f8[::1]))(f8[:,::1], f8[:,::1], f8[::1], f8[::1], b1[::1], b1[::1], f8[::1], f8)"
)
def tightened(
    gradient: Array,
    spread: Array,
    bound: Array,
    kept_off: Array,
    too_near: NDArray[np.bool_],
    translating: NDArray[np.bool_],
    stay: Array,
    room: float,
) -> tuple[Array, Array, Array]:
    """Return the rows, tightened by the clearance margin: `PlanSearch.with_clearance_margin`.

    Args:
        kept_off (rows,) [m]: the clearance margin of each row.
        too_near (rows,): rows that stay as they are, because turning in place would not keep that margin.
        translating (nz,): the regressors that move the robot.
        stay (nz,): regressors of the plan that moves the robot least.
        room [m]: how much nearer than that plan the robot may come to the half-spaces of rows that are too near.

    Returns:
        Gradient, spread and bound of the rows, and after them one row more for each row that is too near.
    """
    count, further = len(bound), 0
    for r in range(count):
        further += too_near[r]
    total = count + further
    slopes, spreads = np.zeros((total, gradient.shape[1])), np.zeros((total, spread.shape[1]))
    bounds, last = np.empty(total), count
    for r in range(count):
        for j in range(gradient.shape[1]):
            slopes[r, j] = gradient[r, j]
        for k in range(spread.shape[1]):
            spreads[r, k] = spread[r, k]
        bounds[r] = bound[r]
        if not too_near[r]:
            bounds[r] -= kept_off[r]
            continue
        bounds[last] = room
        for j in range(gradient.shape[1]):
            if translating[j]:
                slopes[last, j] = gradient[r, j]
                bounds[last] += gradient[r, j] * stay[j]
        last += 1
    return slopes, spreads, bounds


@compiled("Tuple((f8[::1], f8[::1]))(f8[::1], f8[::1], f8[:,::1], f8[::1])")
def reachable(low: Array, high: Array, change: Array, before: Array) -> tuple[Array, Array]:
    """Return center and half-widths (F·m,) of the inputs that bounds and slew leave.

    low, high (m,): bounds; change (F, m): the most that each free input may differ from the input `before` (m,).
    """
    F, m = change.shape
    center, radius = np.empty(F * m), np.empty(F * m)
    for k in range(F):
        for i in range(m):
            least, most = before[i] - change[k, i], before[i] + change[k, i]
            least, most = least if least > low[i] else low[i], most if most < high[i] else high[i]
            center[k * m + i], radius[k * m + i] = 0.5 * (least + most), 0.5 * (most - least)
    return center, radius


@compiled("f8[:,::1](f8[:,::1], f8[:,::1], f8[::1], f8[::1], f8[::1])")
def atom_range(W_known: Array, W_f: Array, z_0: Array, center: Array, radius: Array) -> Array:
    """Return the least and the largest |W z| (2, q) over all free inputs within `radius` of `center` (F·m,)."""
    ranges = np.empty((2, len(W_f)))
    for i in range(len(W_f)):
        atom, deviation = 0.0, 0.0
        for j in range(len(z_0)):
            atom += W_known[i, j] * z_0[j]
        for j in range(len(center)):
            atom += W_f[i, j] * center[j]
            deviation += abs(W_f[i, j]) * radius[j]
        ranges[0, i], ranges[1, i] = max(abs(atom) - deviation, 0.0), abs(atom) + deviation
    return ranges


@compiled(
    "Tuple((i8, f8[:,::1], f8[::1]))"
    "(f8[:,::1], f8[:,::1], f8[::1], f8[::1], f8[::1], f8[:,::1], f8[::1], f8[::1], f8[:,::1], f8[::1], f8,"
    " f8[:,::1], f8[::1], f8[:,::1])"
)
def presolved_rows(
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
    tightening: float,
    fixed: Array,
    fixed_bound: Array,
    fixed_slope: Array,
) -> tuple[int, Array, Array]:
    """Substitute the known regressors into the rows of a QP, and leave out rows that no input can violate.

    A row is `gradient z + spread (constant + M t) <= bound - tightening`, with z = [z_0; f]. The free inputs f are
    within `radius` of `center` (F·m,); the slacks t are between atoms[0] and atoms[1] (q,). The rows that every QP has
    come last: `fixed [f; t] <= fixed_bound + fixed_slope z_0`.

    Returns:
        (count, A, b): the first `count` rows of A, b are all rows, as rows of [f; t] in units of `scale`, each of unit
        length. count is -1 if one row rules out every input.
    """
    known, free, q, last = len(z_0), len(center), M.shape[1], len(fixed)
    A, b, count = np.empty((len(bound) + last, free + q)), np.empty(len(bound) + last), 0
    for r in range(len(bound)):
        row, remaining = A[count], bound[r] - tightening
        for j in range(known):
            remaining -= gradient[r, j] * z_0[j]
        least, most = 0.0, 0.0
        for j in range(free):
            row[j] = gradient[r, known + j]
            least += row[j] * center[j] - abs(row[j]) * radius[j]
            most += row[j] * center[j] + abs(row[j]) * radius[j]
        row[free:] = 0.0
        for k in range(len(constant)):
            share = spread[r, k]
            if share != 0.0:  # most generators are other periods'
                remaining -= share * constant[k]
                for j in range(q):
                    row[free + j] += share * M[k, j]
        for j in range(q):
            least += row[free + j] * atoms[0, j]
            most += row[free + j] * atoms[1, j]
        if least > remaining:
            return -1, A, b
        if most > remaining:
            square = 0.0
            for j in range(free + q):
                row[j] *= scale[j]
                square += row[j] * row[j]
            length = max(np.sqrt(square), tightening)
            for j in range(free + q):
                row[j] /= length
            b[count] = remaining / length
            count += 1
    A[count : count + last], b[count : count + last] = fixed, fixed_bound
    for j in range(known):
        b[count : count + last] += fixed_slope[:, j] * z_0[j]
    return count + last, A, b

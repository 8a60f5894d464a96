"""The rows of a QP that are active in its solution: a quick guess, and the exact ones.

The guess is Hildreth's dual coordinate ascent (1957). The exact rows come from the dual active-set method of Goldfarb
and Idnani (1983), which `batch.dual_active_set` has for many problems at once.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from brakeline.compilation import compiled

Array = NDArray[np.float64]

LEAST_GAIN = 1e-14  # of the dual objective by one step; with less, the ascent ends
TOLERANCE = 1e-11  # of unit rows in scaled variables, and of their multipliers
DEPENDENT = 1e-11  # share of a row's curvature that other rows leave it; below, it counts as their combination
MOST_STEPS = 100


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


@compiled("Tuple((i8[::1], f8[:,::1], f8[::1]))(f8[::1], f8[::1], f8[:,::1], f8[::1], i8, i8)")
def likely_rows(
    h: Array, g: Array, A: Array, b: Array, always: int, steps: int
) -> tuple[NDArray[np.int64], Array, Array]:
    """Return the indices (k,), A (k, n) and b (k,) of the rows of `hildreth_active_set` and of the last `always`."""
    chosen = hildreth_active_set(h, g, A, b, steps)
    chosen[len(b) - always :] = True
    index = np.flatnonzero(chosen)
    return index, A[index], b[index]


@compiled("i8[::1](f8[::1], i8[::1], f8)")
def carrying_rows(multiplier: Array, index: NDArray[np.int64], least: float) -> NDArray[np.int64]:
    """Return the indices of the rows with multipliers (k,) above `least`, the largest first."""
    order = np.argsort(-multiplier, kind="mergesort")
    return index[order[multiplier[order] > least]]


@compiled("i8(i8[::1], f8[::1], i8, i8)")
def _without(active: NDArray[np.int64], multiplier: Array, count: int, which: int) -> int:
    """Remove one of the active rows, with its multiplier; return how many are left."""
    for i in range(which, count - 1):
        active[i], multiplier[i] = active[i + 1], multiplier[i + 1]
    return count - 1


@compiled("void(f8[::1], f8[:,::1], i8[::1], i8, f8[::1])")
def _solve_gram(h: Array, A: Array, active: NDArray[np.int64], count: int, x: Array) -> None:
    """Solve `N diag(h)⁻¹ Nᵀ y = x` for the active rows N, which are independent; x holds y then."""
    n, gram = len(h), np.empty((count, count))
    for i in range(count):
        for j in range(i, count):
            total = 0.0
            for k in range(n):
                total += A[active[i], k] * A[active[j], k] / h[k]
            gram[i, j] = gram[j, i] = total
    for i in range(count):
        for row in range(i + 1, count):
            factor = gram[row, i] / gram[i, i]
            for k in range(i + 1, count):
                gram[row, k] -= factor * gram[i, k]
            x[row] -= factor * x[i]
    for i in range(count - 1, -1, -1):
        for k in range(i + 1, count):
            x[i] -= gram[i, k] * x[k]
        x[i] /= gram[i, i]


@compiled("void(f8[::1], f8[::1], f8[:,::1], f8[::1], i8[::1], i8, f8[::1])")
def _multipliers(
    h: Array, g: Array, A: Array, b: Array, active: NDArray[np.int64], count: int, multiplier: Array
) -> None:
    """Compute the multipliers of the active rows as equations."""
    for i in range(count):
        multiplier[i] = -b[active[i]]
        for k in range(len(h)):
            multiplier[i] -= A[active[i], k] * g[k] / h[k]
    _solve_gram(h, A, active, count, multiplier)


@compiled("f8[::1](f8[::1], f8[::1], f8[:,::1], i8[::1], i8, f8[::1])")
def _minimum(h: Array, g: Array, A: Array, active: NDArray[np.int64], count: int, multiplier: Array) -> Array:
    """Return the x (n,) that the multipliers of the active rows give."""
    x = np.empty(len(h))
    for k in range(len(h)):
        x[k] = -g[k]
        for i in range(count):
            x[k] -= multiplier[i] * A[active[i], k]
        x[k] /= h[k]
    return x


@compiled("Tuple((i8, f8))(f8[:,::1], f8[::1], f8[::1])")
def _most_violated(A: Array, b: Array, x: Array) -> tuple[int, float]:
    """Return the row that x violates most, and by how much. NaN is never the most."""
    row, most = -1, -np.inf
    for i in range(len(b)):
        over = -b[i]
        for k in range(len(x)):
            over += A[i, k] * x[k]
        if over > most:
            row, most = i, over
    return row, most


@compiled("f8(f8[::1], f8[:,::1], i8[::1], i8, i8, f8[::1], f8[::1])")
def _curvature(
    h: Array, A: Array, active: NDArray[np.int64], count: int, row: int, pull: Array, direction: Array
) -> float:
    """Compute how the multipliers (`pull`) and x (`direction`) change with the multiplier of another row.

    Return the curvature along it; 0 if the row is a combination of the active ones.
    """
    n = len(h)
    for i in range(count):
        pull[i] = 0.0
        for k in range(n):
            pull[i] += A[active[i], k] * A[row, k] / h[k]
    _solve_gram(h, A, active, count, pull)
    curvature, own = 0.0, 0.0
    for k in range(n):
        rest = A[row, k]
        for i in range(count):
            rest -= pull[i] * A[active[i], k]
        direction[k] = rest / h[k]
        curvature += A[row, k] * direction[k]
        own += A[row, k] * A[row, k] / h[k]
    return curvature if count < n and curvature > DEPENDENT * own else 0.0


@compiled("f8[::1](f8[::1], f8[::1], f8[:,::1], f8[::1], i8[::1], i8, f8[::1])")
def _checked(h: Array, g: Array, A: Array, b: Array, active: NDArray[np.int64], count: int, multiplier: Array) -> Array:
    """Compute the solution (n,) anew from the active rows; NaN unless it meets the optimality conditions."""
    _multipliers(h, g, A, b, active, count, multiplier)
    x = _minimum(h, g, A, active, count, multiplier)
    good = True
    for i in range(count):
        good &= multiplier[i] >= -TOLERANCE
    for i in range(len(b)):
        over = -b[i]
        for k in range(len(x)):
            over += A[i, k] * x[k]
        good &= over <= TOLERANCE  # false for NaN
    return x if good else np.full(len(x), np.nan)


@compiled("Tuple((f8[::1], b1))(f8[::1], f8[::1], f8[:,::1], f8[::1], i8[::1])")
def exact_solution(h: Array, g: Array, A: Array, b: Array, guess: NDArray[np.int64]) -> tuple[Array, bool]:
    """Return the solution (n,) of `min ½ xᵀ diag(h) x + gᵀ x  s.t.  A x <= b`, and whether there is none.

    If the method finds neither a solution nor a proof that there is none, it returns NaN and false.

    guess: indices of rows that may be active. The method begins with those of them that are independent and have
    multipliers of at least zero. Then it adds the row that is violated most, and drops rows whose multipliers reach
    zero, until no row is violated.
    """
    n = len(h)
    active, count = np.empty(n, np.int64), 0
    multiplier, pull, direction = np.zeros(n + 1), np.empty(n), np.empty(n)
    for row in guess:
        if count < n and _curvature(h, A, active, count, row, pull, direction) > 0.0:
            active[count] = row
            count += 1
    while count:
        _multipliers(h, g, A, b, active, count, multiplier)
        worst = int(multiplier[:count].argmin())
        if multiplier[worst] >= 0.0:
            break
        count = _without(active, multiplier, count, worst)
    x = _minimum(h, g, A, active, count, multiplier)
    row, over, added = -1, 0.0, 0.0
    for _ in range(MOST_STEPS):
        if row < 0:
            row, over = _most_violated(A, b, x)
            added = 0.0
            if not over > TOLERANCE:
                return _checked(h, g, A, b, active, count, multiplier), False
        curvature = _curvature(h, A, active, count, row, pull, direction)
        full, first, partial = np.inf, -1, np.inf
        if curvature > 0.0:
            full = over / curvature
        for i in range(count):
            if pull[i] > 0.0 and multiplier[i] / pull[i] < partial:
                first, partial = i, multiplier[i] / pull[i]
        length = min(full, partial)
        if not length < np.inf:  # no x meets all rows
            return np.full(n, np.nan), True
        if curvature > 0.0:
            x -= length * direction
            over -= length * curvature
        multiplier[:count] -= length * pull[:count]
        added += length
        if full <= partial:
            active[count], multiplier[count] = row, added
            count += 1
            row = -1
        else:
            count = _without(active, multiplier, count, first)
    return np.full(n, np.nan), False

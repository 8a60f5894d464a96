"""Solves many small strictly convex QPs at once: the dual active-set method of Goldfarb and Idnani (1983).

    min ½ xᵀ diag(h) x + gᵀ x   s.t.  A x <= b          one problem a lane, the batch last: x (n, B)

The method starts at the minimum under no rows, adds the row that is violated most, and takes steps that keep all
multipliers at least zero. It ends after finitely many steps at the exact solution, or proves that there is none. All
lanes step together; lanes that have ended leave. The answer is then computed anew from its active rows, and counts as
solved only if it meets the optimality conditions of Karush, Kuhn and Tucker to within ten times `TOLERANCE`, with
multipliers that are not too large.

References:
    D. Goldfarb, A. Idnani: A numerically stable dual method for solving strictly convex quadratic programs, 1983.
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Any

from brakeline.safety.filter.batch.obstacle_arrays import Array

MOST_STEPS = 60  # a lane that has not ended then counts as not solved
TOLERANCE = 1e-12  # of unit rows in scaled variables, and of their multipliers
LARGEST = 1e3  # multiplier: with a larger one, the rounding of a row moves the solution by too much
DEPENDENT = 1e-11  # share of a row's curvature that other rows leave it; below, it counts as their combination
LEFT = 0.7  # share of running lanes, below which the others are dropped from the arrays


@dataclass(frozen=True)
class BatchSolution:
    """Solutions of a batch of QPs."""

    x: Array  # (n, B): solutions; meaningless in a lane that is not solved
    solved: Array  # (B,): the lane meets the optimality conditions
    infeasible: Array  # (B,): the method found that no x meets all rows
    steps: Array  # (B,): steps of the method


@dataclass
class _Lanes:
    """The state of all running lanes."""

    lane: Array  # (B,): index in the batch
    # A (r, n, B), b (r, B), minimum (n, B): the problems; `minimum` under no rows
    A: Array
    b: Array
    minimum: Array
    x: Array  # (n, B): the iterate
    steps: Array  # (B,)
    # rows (n, n, B), sides (n, B), used (n, B), multiplier (n, B): slots for active rows: A, b, whether in use
    rows: Array
    sides: Array
    used: Array
    multiplier: Array
    # row (n, B), side (B,), added (B,), waits (B,): the row to be added, its multiplier, whether there is one
    row: Array
    side: Array
    added: Array
    waits: Array

    def take(self, xp: Any, index: Array) -> _Lanes:
        return _Lanes(*(xp.take(getattr(self, f.name), index, axis=-1) for f in fields(self)))


def solve_batch(xp: Any, h: Array, g: Array, A: Array, b: Array, guess: Array) -> BatchSolution:
    """Solve a batch of QPs.

    Args:
        xp: the namespace of the arrays.
        h (n, 1): diagonal of the cost, positive. g (n, B): its gradient.
        A (r, n, B), b (r, B): the rows; a row that a lane does not use is zero, with b >= 0.
        guess (k, B): indices of rows that may be active, k <= n. Lanes in which they are not start without them.
    """
    n, count = g.shape
    minimum = -g / h
    zeros = xp.zeros_like(g)
    slots = xp.zeros((n, n, count), dtype=g.dtype, device=g.device)
    alone, none = xp.zeros_like(g[0]), xp.zeros_like(g[0], dtype=xp.bool)
    lane = xp.arange(count, device=g.device)
    used = xp.zeros_like(g, dtype=xp.bool)
    lanes = _Lanes(
        *(lane, A, b, minimum, xp.asarray(minimum, copy=True), xp.zeros_like(lane), slots, zeros, used),
        *(xp.asarray(zeros, copy=True), xp.asarray(zeros, copy=True), alone, xp.asarray(alone, copy=True), none),
    )
    _start_with(xp, h, lanes, guess)
    x, solved, infeasible = xp.zeros_like(g), xp.zeros_like(none), xp.zeros_like(none)
    steps = xp.zeros_like(lane)
    for _ in range(MOST_STEPS):
        ended, stuck = _step(xp, h, lanes)
        if bool(xp.any(ended)):
            done = lanes.take(xp, xp.nonzero(ended)[0])
            x[:, done.lane], solved[done.lane] = _checked(xp, h, done)
            steps[done.lane] = done.steps
        infeasible[lanes.lane[stuck]] = True
        running = ~(ended | stuck)
        left = int(xp.sum(xp.astype(running, xp.int64)))
        if not left:
            break
        if left < LEFT * running.shape[0]:  # until then, lanes that have ended step on without effect
            lanes = lanes.take(xp, xp.nonzero(running)[0])
    return BatchSolution(x, solved, infeasible & ~solved, steps)


def _start_with(xp: Any, h: Array, lanes: _Lanes, guess: Array) -> None:
    """Begin with guessed rows as the active ones, in the lanes in which all their multipliers are at least zero."""
    k, n = guess.shape[0], lanes.x.shape[0]
    rows = xp.take_along_axis(lanes.A, xp.broadcast_to(guess[:, None], (k, n, guess.shape[1])), axis=0)
    sides = xp.take_along_axis(lanes.b, guess, axis=0)
    trial_rows, trial_sides = xp.zeros_like(lanes.rows), xp.zeros_like(lanes.sides)
    trial_rows[:k], trial_sides[:k] = rows, sides
    trial_used = xp.zeros_like(lanes.used)
    trial_used[:k] = True
    multiplier = _multipliers(xp, h, lanes.minimum, trial_rows, trial_sides, trial_used)
    good = xp.all(multiplier >= 0.0, axis=0)
    lanes.used = trial_used & good
    lanes.rows, lanes.sides = trial_rows * good, trial_sides * good
    lanes.multiplier = xp.where(good, multiplier, 0.0)
    lanes.x = lanes.minimum - xp.sum(lanes.rows * lanes.multiplier[:, None], axis=0) / h


def _step(xp: Any, h: Array, lanes: _Lanes) -> tuple[Array, Array]:
    """Take one step in every lane. Return the lanes that meet all rows, and those in which no x can (B,)."""
    n = lanes.x.shape[0]
    violation = -lanes.b
    for j in range(n):
        violation = violation + lanes.A[:, j] * lanes.x[j]
    worst = xp.argmax(violation, axis=0)[None]
    ended = ~lanes.waits & ~(xp.take_along_axis(violation, worst, axis=0)[0] > TOLERANCE)
    fresh = ~lanes.waits
    new = xp.take_along_axis(lanes.A, xp.broadcast_to(worst[:, None], (1, n, worst.shape[1])), axis=0)[0]
    lanes.row = xp.where(fresh, new, lanes.row)
    lanes.side = xp.where(fresh, xp.take_along_axis(lanes.b, worst, axis=0)[0], lanes.side)
    lanes.added = xp.where(fresh, 0.0, lanes.added)
    # The direction of the step: of the unknowns, and of the multipliers of the active rows.
    towards = lanes.row / h
    pull = _solve_positive(xp, _gram(xp, h, lanes.rows, lanes.used), xp.sum(lanes.rows * towards, axis=1))
    direction = (lanes.row - xp.sum(lanes.rows * pull[:, None], axis=0)) / h
    curvature = xp.sum(lanes.row * direction, axis=0)
    free = curvature > DEPENDENT * xp.sum(lanes.row * towards, axis=0)
    over = xp.sum(lanes.row * lanes.x, axis=0) - lanes.side
    full = xp.where(free, over / xp.where(free, curvature, 1.0), xp.inf)
    falls = lanes.used & (pull > 0.0)
    until_zero = xp.where(falls, lanes.multiplier / xp.where(falls, pull, 1.0), xp.inf)
    first = xp.argmin(until_zero, axis=0)
    partial = xp.min(until_zero, axis=0)
    length = xp.minimum(full, partial)
    stuck = ~ended & ~(length < xp.inf)
    length = xp.where(ended | stuck, 0.0, length)
    lanes.x = lanes.x - length * xp.where(free, direction, 0.0)
    lanes.multiplier = xp.where(lanes.used, lanes.multiplier - length * pull, 0.0)
    lanes.added = lanes.added + length
    moves = ~(ended | stuck)
    joins, leaves = moves & (full <= partial), moves & (full > partial)
    slot = xp.arange(n, device=lanes.x.device)[:, None]
    enters = joins & (slot == xp.argmax(xp.astype(~lanes.used, xp.int8), axis=0))
    drops = leaves & (slot == first)
    lanes.rows = xp.where(enters[:, None], lanes.row[None], xp.where(drops[:, None], 0.0, lanes.rows))
    lanes.sides = xp.where(enters, lanes.side, xp.where(drops, 0.0, lanes.sides))
    lanes.multiplier = xp.where(enters, lanes.added, xp.where(drops, 0.0, lanes.multiplier))
    lanes.used = (lanes.used | enters) & ~drops
    lanes.waits = leaves | (lanes.waits & ~moves)
    lanes.steps = lanes.steps + xp.astype(moves, lanes.steps.dtype)
    return ended, stuck


def _checked(xp: Any, h: Array, lanes: _Lanes) -> tuple[Array, Array]:
    """Compute the solutions (n, B) anew from their active rows; return also which meet the optimality conditions."""
    multiplier = _multipliers(xp, h, lanes.minimum, lanes.rows, lanes.sides, lanes.used)
    x = lanes.minimum - xp.sum(lanes.rows * multiplier[:, None], axis=0) / h
    violation = -lanes.b
    for j in range(x.shape[0]):
        violation = violation + lanes.A[:, j] * x[j]
    off = xp.abs(xp.sum(lanes.rows * x, axis=1) - lanes.sides) * lanes.used
    met = (xp.max(violation, axis=0) <= 10.0 * TOLERANCE) & (xp.max(off, axis=0) <= 10.0 * TOLERANCE)
    return x, met & (xp.min(multiplier, axis=0) >= -TOLERANCE) & (xp.max(multiplier, axis=0) <= LARGEST)


def _multipliers(xp: Any, h: Array, minimum: Array, rows: Array, sides: Array, used: Array) -> Array:
    """Return the multipliers (n, B) of active rows as equations; 0 in empty slots."""
    over = xp.sum(rows * minimum, axis=1) - sides
    return _solve_positive(xp, _gram(xp, h, rows, used), xp.where(used, over, 0.0))


def _gram(xp: Any, h: Array, rows: Array, used: Array) -> Array:
    """Return the Gram matrices (k, k, B) of active rows in the metric of the cost; 1 on an empty slot's diagonal."""
    n = rows.shape[1]
    gram = xp.zeros((n, n, rows.shape[2]), dtype=rows.dtype, device=rows.device)
    for j in range(n):
        gram += rows[:, None, j] * (rows[:, j] / h[j])
    diagonal = xp.arange(n, device=rows.device)
    gram[diagonal, diagonal] += xp.astype(~used, gram.dtype)
    return gram


def _solve_positive(xp: Any, matrix: Array, right: Array) -> Array:
    """Solve positive definite systems: matrix (k, k, B), which is overwritten, and right side (k, B)."""
    k = right.shape[0]
    x = xp.asarray(right, copy=True)
    for i in range(k - 1):
        factor = matrix[i + 1 :, i] / matrix[i, i]
        matrix[i + 1 :, i + 1 :] -= factor[:, None] * matrix[i, i + 1 :]
        x[i + 1 :] -= factor * x[i]
    for i in reversed(range(k)):
        if i + 1 < k:
            x[i] -= xp.sum(matrix[i, i + 1 :] * x[i + 1 :], axis=0)
        x[i] /= matrix[i, i]
    return x

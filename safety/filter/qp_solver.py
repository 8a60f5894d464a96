"""Solves a QP with ProxQP. Its answer is a candidate; the filter verifies it with the exact tube."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from proxsuite import proxqp

from brakeline.safety.filter.kernels.active_set_kernels import hildreth_active_set

Array = NDArray[np.float64]
Index = NDArray[np.int64]

ACCURACY = 1e-6  # of unit rows in scaled variables: about 1e-7 m
# With the default tolerance feasible problems were called infeasible; see the solver's own `eps_primal_inf`.
NOT_INFEASIBLE = 1e-12
SOLVED = "solved"
MOST_ITERATIONS = 100
MOST_INNER_ITERATIONS = 50
# Only a few rows are active in a solution. The solver gets the rows of a quick guess (`hildreth_active_set`), then also
# the `FEW` rows that its answer violates most, and so on. An answer that meets all rows solves the whole problem. These
# small problems need a high accuracy, since no other rows keep the answer off the edge. If this does not end soon, or
# if a small problem counts as infeasible (13 of 9,727 were feasible), the solver gets all rows. The rows have unit
# length, so small problems need no preconditioner, and a firm penalty (`FIRMNESS`) makes them converge sooner.
STEPS, FEW, ROUNDS, SOON = 20, 5, 8, 30  # STEPS: of the ascent; SOON: iterations
EXACT, FIRMNESS = 1e-7, 1e-2
# ProxQP's answer is off by up to 1e-3 where rows are nearly parallel. The rows that carry it give the exact one.
CARRIES = 1e-7  # least multiplier of a row that carries an answer
ROUNDED, DEPENDENT, MOST_EXCHANGES = 1e-11, 1e-11, 12


@dataclass(frozen=True)
class QuadraticProgram:
    """The problem `min ½ xᵀ diag(h) x + gᵀ x  s.t.  A x <= b`."""

    # h, g (n,): diagonal and gradient of the cost
    h: Array
    g: Array
    # A (rows, n), b (rows,): the constraints
    A: Array
    b: Array
    always: int = 0  # number of last rows (bounds and slew) that every reduced problem includes from the start


@dataclass(frozen=True)
class Solution:
    """x (n,), the solver's status, its iterations, and the recomputed residual of the rows (positive: violated).

    carrying: indices of the rows whose multipliers are above `CARRIES`.
    """

    x: Array
    status: str
    iterations: int
    residual: float
    carrying: Index = field(default_factory=lambda: np.zeros(0, dtype=np.int64))

    @property
    def found(self) -> bool:
        return bool(np.isfinite(self.x).all())


INFEASIBLE = Solution(np.array([np.nan]), "ruled out", 0, np.inf)  # of a program that need not be solved


def solve(program: QuadraticProgram) -> Solution:
    """Solve with a cold start: the answer depends on the problem alone, so a log can be replayed."""
    solution = _by_few(program) or _solved(program)
    return _polished(program, solution) if solution.found and len(program.b) else solution


def _polished(program: QuadraticProgram, solution: Solution) -> Solution:
    """Return the exact solution by the rows that carry it, or the given one if that does not succeed.

    With these rows as equations, the solution follows from linear equations. A row with a negative multiplier carries
    nothing and leaves; a violated one joins. `einsum` calls no BLAS, whose sums depend on the processor.
    """
    h, g, A, b = program.h, program.g, program.A, program.b
    rows = solution.carrying.tolist()
    for _ in range(MOST_EXCHANGES):
        active = A[rows]
        gram = np.einsum("ik,jk->ij", active / h, active)
        multiplier = _eliminated(gram, -(b[rows] + np.einsum("ik,k->i", active, g / h)))
        if multiplier is None:
            return solution
        if rows and multiplier.min() < 0.0:
            rows.pop(int(multiplier.argmin()))
            continue
        x = -(g + np.einsum("i,ij->j", multiplier, active)) / h
        left = np.einsum("ij,j->i", A, x) - b
        worst = int(left.argmax())
        if left[worst] <= ROUNDED:
            return Solution(x, SOLVED, solution.iterations, float(left[worst]), np.array(rows, dtype=np.int64))
        if not left[worst] > ROUNDED or worst in rows:  # NaN, or rows that depend on each other
            return solution
        rows.append(worst)
    return solution


def _eliminated(matrix: Array, right: Array) -> Array | None:
    """Solve linear equations of a positive matrix by Gaussian elimination; None if rows depend on each other."""
    upper, y = matrix.copy(), right.copy()
    for i in range(len(y)):
        if not upper[i, i] > DEPENDENT * matrix[i, i]:
            return None
        factor = upper[i + 1 :, i] / upper[i, i]
        upper[i + 1 :] -= factor[:, None] * upper[i]
        y[i + 1 :] -= factor * y[i]
    for i in reversed(range(len(y))):
        y[i] = (y[i] - (upper[i, i + 1 :] * y[i + 1 :]).sum()) / upper[i, i]
    return y


def _by_few(program: QuadraticProgram) -> Solution | None:
    """Solve with as few rows as suffice; None if that does not succeed soon."""
    inside, iterations = hildreth_active_set(program.h, program.g, program.A, program.b, STEPS), 0
    inside[len(program.b) - program.always :] = True
    for _ in range(ROUNDS):
        rows = QuadraticProgram(program.h, program.g, program.A[inside], program.b[inside])
        part = _solved(rows, few=True)
        iterations += part.iterations
        if part.status != SOLVED:
            return None
        left = program.A @ part.x - program.b
        residual = float(left.max(initial=-np.inf))
        if residual <= 2.0 * EXACT:
            return Solution(part.x, part.status, iterations, residual, np.flatnonzero(inside)[part.carrying])
        inside[np.argsort(-np.where(inside, -np.inf, left), kind="stable")[:FEW]] = True
    return None


def _solved(program: QuadraticProgram, few: bool = False) -> Solution:
    rows, n = program.A.shape
    qp = proxqp.dense.QP(n, 0, rows)
    settings = qp.settings
    settings.initial_guess = proxqp.InitialGuess.NO_INITIAL_GUESS
    settings.eps_abs = EXACT if few else ACCURACY
    settings.eps_rel = 0.0
    settings.eps_primal_inf = NOT_INFEASIBLE
    settings.eps_dual_inf = NOT_INFEASIBLE
    settings.max_iter = SOON if few else MOST_ITERATIONS
    settings.max_iter_in = MOST_INNER_ITERATIONS
    settings.verbose = False
    parts = np.diag(program.h), program.g, None, None, program.A, None, program.b
    if few:
        # By its residuals alone one answer in seventy was off by more than a thousandth of an input's range.
        settings.check_duality_gap = True
        settings.eps_duality_gap_abs, settings.eps_duality_gap_rel = EXACT, 0.0
        qp.init(*parts, compute_preconditioner=False, mu_in=FIRMNESS)
    else:
        qp.init(*parts)
    qp.solve()
    x = np.array(qp.results.x)
    status = str(qp.results.info.status).rsplit(".", maxsplit=1)[-1].removeprefix("PROXQP_").lower()
    residual = float((program.A @ x - program.b).max()) if rows else 0.0
    carrying = np.flatnonzero(np.array(qp.results.z) > CARRIES)
    return Solution(x, status, int(qp.results.info.iter), residual, carrying)

"""Solves a QP with ProxQP. Its answer is a candidate; the filter verifies it with the exact tube."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray
from proxsuite import proxqp

from brakeline.safety.filter.kernels.active_set_kernels import exact_solution, hildreth_active_set

Array = NDArray[np.float64]
Index = NDArray[np.int64]

ACCURACY = 1e-6  # of unit rows in scaled variables: about 1e-7 m
# With the default tolerance feasible problems were called infeasible; see the solver's own `eps_primal_inf`.
NOT_INFEASIBLE = 1e-12
SOLVED = "solved"
MOST_ITERATIONS = 100
MOST_INNER_ITERATIONS = 50
INFEASIBLE_ROWS = "primal_infeasible"
# Only a few rows are active in a solution, so the solver first gets the rows of a quick guess (`hildreth_active_set`).
# Its answer, also to all rows, is off by up to 0.03 of an input's range where rows are nearly parallel. From the rows
# that carry it, a few steps of an active-set method find the exact solution of all rows, or that there is none. They
# also correct the verdict that few rows are infeasible (13 of 9,727 were feasible). If they find neither, the solver
# gets all rows; it takes up to 30 ms to find that there is no solution. The rows have unit length, so small problems
# need no preconditioner, and a firm penalty (`FIRMNESS`) makes them converge sooner.
STEPS, SOON = 20, 30  # STEPS: of the ascent; SOON: iterations
EXACT, FIRMNESS = 1e-7, 1e-2
CARRIES = 1e-7  # least multiplier of a row that carries an answer


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

    carrying: indices of the rows whose multipliers are above `CARRIES`, the largest first.
    """

    x: Array
    status: str
    iterations: int
    residual: float
    carrying: Index = field(default_factory=lambda: np.zeros(0, dtype=np.int64))

    @property
    def found(self) -> bool:
        return bool(np.isfinite(self.x).all())


NOTHING = np.array([np.nan])
INFEASIBLE = Solution(NOTHING, "ruled out", 0, np.inf)  # of a program that need not be solved


def solve(program: QuadraticProgram) -> Solution:
    """Solve with a cold start: the answer depends on the problem alone, so a log can be replayed."""
    inside = hildreth_active_set(program.h, program.g, program.A, program.b, STEPS)
    inside[len(program.b) - program.always :] = True
    few = _solved(QuadraticProgram(program.h, program.g, program.A[inside], program.b[inside]), few=True)
    carrying = few.carrying[:0] if few.status == INFEASIBLE_ROWS else np.flatnonzero(inside)[few.carrying]
    exact = _exact(program, few, carrying)
    if exact is None:
        solution = _solved(program)
        exact = _exact(program, solution, solution.carrying) or solution
    return exact


def _exact(program: QuadraticProgram, solution: Solution, carrying: Index) -> Solution | None:
    """Return the exact solution of a program, or that there is none, from the rows that carry a solution of some rows.

    None if the method finds neither.
    """
    x, impossible = exact_solution(program.h, program.g, program.A, program.b, carrying)
    if np.isfinite(x).all():
        residual = float((program.A @ x - program.b).max(initial=-np.inf))
        return replace(solution, x=x, status=SOLVED, residual=residual, carrying=carrying)
    if impossible or solution.status == INFEASIBLE_ROWS:
        return replace(solution, x=NOTHING, status=INFEASIBLE_ROWS)
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
    multipliers = np.array(qp.results.z)
    order = np.argsort(-multipliers, kind="stable")
    carrying = order[multipliers[order] > CARRIES]
    return Solution(x, status, int(qp.results.info.iter), residual, carrying)

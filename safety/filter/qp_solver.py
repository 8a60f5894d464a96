"""Solves a QP with ProxQP. Its answer is a candidate; the filter verifies it with the exact tube."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from proxsuite import proxqp

from brakeline.safety.filter.kernels.active_set_kernels import hildreth_active_set

Array = NDArray[np.float64]

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


@dataclass(frozen=True)
class QuadraticProgram:
    """The problem `min ½ xᵀ diag(h) x + gᵀ x  s.t.  A x <= b`.

    Attributes:
        h, g (n,): diagonal and gradient of the cost.
        A (rows, n), b (rows,): the constraints.
        always: number of last rows (bounds and slew) that every reduced problem includes from the start.
    """

    h: Array
    g: Array
    A: Array
    b: Array
    always: int = 0


@dataclass(frozen=True)
class Solution:
    """x (n,), the solver's status, its iterations, and the recomputed residual of the rows (positive: violated)."""

    x: Array
    status: str
    iterations: int
    residual: float

    @property
    def found(self) -> bool:
        return bool(np.isfinite(self.x).all())


INFEASIBLE = Solution(np.array([np.nan]), "ruled out", 0, np.inf)  # of a program that need not be solved


def solve(program: QuadraticProgram) -> Solution:
    """Solve with a cold start: the answer depends on the problem alone, so a log can be replayed."""
    return _by_few(program) or _solved(program)


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
            return Solution(part.x, part.status, iterations, residual)
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
    return Solution(x, status, int(qp.results.info.iter), residual)

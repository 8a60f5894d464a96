"""Solves a QP with ProxQP; what comes back is a candidate, never a proof."""

from __future__ import annotations

from dataclasses import dataclass, replace

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
# Of all rows few decide: those that a quick ascent comes by (`deciding.py`) are solved alone, then with those that the
# answer violates most, and so on. An answer within all rows is the answer to all of them. So few are solved exactly,
# for there are no others to hold the answer off the edge; where that does not come soon, or few are said to be
# impossible (which the solver is quicker to say of few rows: 13 of 9,727 that could be met), all are solved as usual.
# Rows are of unit length already, so few need no preconditioner; and few are met the more exactly, the more it costs at
# once not to meet one (`FIRMNESS`).
STEPS, FEW, ROUNDS, SOON = 20, 5, 8, 30  # STEPS: of the ascent; SOON: iterations
EXACT, FIRMNESS = 1e-7, 1e-2


@dataclass(frozen=True)
class QuadraticProgram:
    """`min ½ xᵀ diag(h) x + gᵀ x  s.t.  A x <= b`: h, g (n,), A (rows, n), b (rows,). The last `always` of them
    (bounds and the like) are looked at from the beginning, whichever others decide."""

    h: Array
    g: Array
    A: Array
    b: Array
    always: int = 0


@dataclass(frozen=True)
class Solution:
    """x (n,), the solver's word, its iterations, and the residual of the rows recomputed here (positive: violated)."""

    x: Array
    status: str
    iterations: int
    residual: float

    @property
    def found(self) -> bool:
        return bool(np.isfinite(self.x).all())


INFEASIBLE = Solution(np.array([np.nan]), "ruled out", 0, np.inf)  # of a program that need not be solved


def solve(program: QuadraticProgram) -> Solution:
    """Cold start: the answer depends on the program alone, so that a log can be replayed."""
    return _by_few(program) or _solved(program)


def _by_few(program: QuadraticProgram) -> Solution | None:
    """By as few rows as will do; None if that does not come soon."""
    inside, iterations = hildreth_active_set(program.h, program.g, program.A, program.b, STEPS), 0
    inside[len(program.b) - program.always :] = True
    for _ in range(ROUNDS):
        part = _solved(replace(program, A=program.A[inside], b=program.b[inside]), few=True)
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
    told = np.diag(program.h), program.g, None, None, program.A, None, program.b
    if few:
        # By its residuals alone one answer in seventy was off by more than a thousandth of an input's range.
        settings.check_duality_gap = True
        settings.eps_duality_gap_abs, settings.eps_duality_gap_rel = EXACT, 0.0
        qp.init(*told, compute_preconditioner=False, mu_in=FIRMNESS)
    else:
        qp.init(*told)
    qp.solve()
    x = np.array(qp.results.x)
    status = str(qp.results.info.status).rsplit(".", maxsplit=1)[-1].removeprefix("PROXQP_").lower()
    residual = float((program.A @ x - program.b).max()) if rows else 0.0
    return Solution(x, status, int(qp.results.info.iter), residual)

"""Solves a QP with ProxQP; what comes back is a candidate, never a proof."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from proxsuite import proxqp

Array = NDArray[np.float64]

ACCURACY = 1e-6  # of unit rows in scaled variables: about 1e-7 m
# With the default tolerance feasible problems were called infeasible; see the solver's own `eps_primal_inf`.
NOT_INFEASIBLE = 1e-12
MOST_ITERATIONS = 100
MOST_INNER_ITERATIONS = 50


@dataclass(frozen=True)
class Program:
    """`min ½ xᵀ diag(h) x + gᵀ x  s.t.  A x <= b`: h, g (n,), A (rows, n), b (rows,)."""

    h: Array
    g: Array
    A: Array
    b: Array


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


def solve(program: Program) -> Solution:
    """Cold start: the answer depends on the program alone, so that a log can be replayed."""
    rows, n = program.A.shape
    qp = proxqp.dense.QP(n, 0, rows)
    settings = qp.settings
    settings.initial_guess = proxqp.InitialGuess.NO_INITIAL_GUESS
    settings.eps_abs = ACCURACY
    settings.eps_rel = 0.0
    settings.eps_primal_inf = NOT_INFEASIBLE
    settings.eps_dual_inf = NOT_INFEASIBLE
    settings.max_iter = MOST_ITERATIONS
    settings.max_iter_in = MOST_INNER_ITERATIONS
    settings.verbose = False
    qp.init(np.diag(program.h), program.g, None, None, program.A, None, program.b)
    qp.solve()
    x = np.array(qp.results.x)
    status = str(qp.results.info.status).rsplit(".", maxsplit=1)[-1].removeprefix("PROXQP_").lower()
    residual = float((program.A @ x - program.b).max()) if rows else 0.0
    return Solution(x, status, int(qp.results.info.iter), residual)

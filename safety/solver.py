"""Solves a QP with ProxQP, by the few of its rows that decide; what comes back is a candidate, never a proof.

ProxQP takes four times as long for a hundred rows as for ten, and of hundreds hardly more decide than there are
variables. Which these are DAQP says, an active-set method; that it is right is seen from all rows.
"""

from __future__ import annotations

from dataclasses import dataclass

import daqp
import numpy as np
from numpy.typing import NDArray
from proxsuite import proxqp

Array = NDArray[np.float64]

ACCURACY = 1e-6  # of unit rows in scaled variables: about 1e-7 m
EXACT = 1e-8  # the same of those that decide: their answer is at the very edge, and must be within by SHARPEN
# With the default tolerance feasible problems were called infeasible; see the solver's own `eps_primal_inf`.
NOT_INFEASIBLE = 1e-12
MOST_ITERATIONS = 100
MOST_INNER_ITERATIONS = 50
TIGHT = 1e-3  # of unit rows: one with more room than this at the answer does not decide
NO_LOWER = -1e30
SOLVED = 1  # DAQP's word


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
    """By the rows that decide, or, where these are not known or their answer violates another, by all of them. Cold
    start: the answer depends on the program alone, so that a log can be replayed."""
    deciding = _deciding(program)
    if deciding is None:
        return _solved(program, program.A, program.b, ACCURACY)
    few = _solved(program, program.A[deciding], program.b[deciding], EXACT)
    if few.status == "solved" and few.residual <= 10.0 * EXACT:
        return few
    return _solved(program, program.A, program.b, ACCURACY)


def _deciding(program: Program) -> NDArray[np.bool_] | None:
    """Which rows the answer is at, or as good as at; None if there is none, or no number in it."""
    rows = len(program.b)
    lower, kinds = np.full(rows, NO_LOWER), np.zeros(rows, dtype=np.intc)
    x, _, word, _ = daqp.solve(np.diag(program.h), program.g.copy(), program.A.copy(), program.b.copy(), lower, kinds)
    return np.asarray(program.A @ x > program.b - TIGHT) if word == SOLVED and np.isfinite(x).all() else None


def _solved(program: Program, A: Array, b: Array, accuracy: float) -> Solution:
    """The answer to a program of which these rows are left, so exactly."""
    rows, n = A.shape
    qp = proxqp.dense.QP(n, 0, rows)
    settings = qp.settings
    settings.initial_guess = proxqp.InitialGuess.NO_INITIAL_GUESS
    settings.eps_abs = accuracy
    settings.eps_rel = 0.0
    settings.eps_primal_inf = NOT_INFEASIBLE
    settings.eps_dual_inf = NOT_INFEASIBLE
    settings.max_iter = MOST_ITERATIONS
    settings.max_iter_in = MOST_INNER_ITERATIONS
    settings.verbose = False
    qp.init(np.diag(program.h), program.g, None, None, A, None, b)
    qp.solve()
    x = np.array(qp.results.x)
    status = str(qp.results.info.status).rsplit(".", maxsplit=1)[-1].removeprefix("PROXQP_").lower()
    residual = float((program.A @ x - program.b).max()) if len(program.b) else 0.0
    return Solution(x, status, int(qp.results.info.iter), residual)

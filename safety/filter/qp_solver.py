"""Solves a QP exactly with DAQP, a dual active-set method. Its answer is a candidate; the filter verifies it.

References:
    D. Arnström, A. Bemporad, D. Axehill: A dual active-set solver for embedded quadratic programming, 2022.
"""

from __future__ import annotations

from dataclasses import dataclass

import daqp
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

TOLERANCE = 1e-12  # by which the answer may violate a row; the filter's rows have unit length in scaled variables
UNBOUNDED = -1e30  # lower bound of rows that have none
SOLVED = "solved"
STATUS = {1: SOLVED, -1: "infeasible", -2: "cycled", -3: "unbounded", -4: "too many iterations"}  # by DAQP's exit flag


@dataclass(frozen=True)
class QuadraticProgram:
    """The problem `min ½ xᵀ diag(h) x + gᵀ x  s.t.  A x <= b`.

    Attributes:
        h, g (n,): diagonal and gradient of the cost.
        A (rows, n), b (rows,): the constraints.
    """

    h: Array
    g: Array
    A: Array
    b: Array


@dataclass(frozen=True)
class Solution:
    """x (n,), the solver's status, its iterations, and the recomputed residual of the rows (positive: violated).

    Without a solution, x is NaN.
    """

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
    h, g, A, b = program.h, program.g, program.A, program.b
    if not all(np.isfinite(part).all() for part in (g, A, b)):
        return Solution(np.full(len(h), np.nan), "not finite", 0, np.inf)
    low, kinds = np.full(len(b), UNBOUNDED), np.zeros(len(b), dtype=np.int32)
    x, _, flag, info = daqp.solve(np.diag(h), g, np.ascontiguousarray(A), b, low, kinds, primal_tol=TOLERANCE)
    status, iterations = STATUS.get(flag, f"exit flag {flag}"), int(info["iterations"])
    if status != SOLVED:
        return Solution(np.full(len(h), np.nan), status, iterations, np.inf)
    x = np.array(x[: len(h)])
    return Solution(x, status, iterations, float((A @ x - b).max()) if len(b) else 0.0)

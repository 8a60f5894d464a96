"""Solves a QP with ProxQP. Its answer is a candidate; the filter verifies it with the exact tube."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from proxsuite import proxqp

from brakeline.safety.filter.kernels.active_set_kernels import carrying_rows, exact_solution, likely_rows

Array = NDArray[np.float64]
Index = NDArray[np.int64]

ACCURACY = 1e-6  # of unit rows in scaled variables: about 1e-7 m
# With the default tolerance feasible problems were called infeasible; see the solver's own `eps_primal_inf`.
NOT_INFEASIBLE = 1e-12
SOLVED = "solved"
MOST_ITERATIONS = 100
MOST_INNER_ITERATIONS = 50
INFEASIBLE_ROWS = "primal_infeasible"
# Only a few rows are active in a solution, so the solver first gets the rows of a quick guess (`likely_rows`). Its
# answer, also to all rows, is off by up to 0.03 of an input's range where rows are nearly parallel. From the rows that
# carry it, a few steps of an active-set method find the exact solution of all rows, or that there is none. They also
# correct the verdict that few rows are infeasible (13 of 9,727 were feasible). So a rough answer to few rows is enough
# (`ROUGH`). If the method finds neither, the solver gets all rows; it takes up to 30 ms to find that there is no
# solution. The rows have unit length, so small problems need no preconditioner, and a firm penalty (`FIRMNESS`) makes
# them converge sooner.
STEPS, SOON = 20, 30  # STEPS: of the ascent; SOON: iterations
ROUGH, FIRMNESS = 1e-3, 1e-2
CARRIES = 1e-7  # least multiplier of a row that carries an answer


def _settings(accuracy: float, iterations: int) -> proxqp.Settings:
    settings = proxqp.Settings()
    settings.initial_guess = proxqp.InitialGuess.NO_INITIAL_GUESS
    settings.eps_abs, settings.eps_rel = accuracy, 0.0
    settings.eps_primal_inf = settings.eps_dual_inf = NOT_INFEASIBLE
    settings.max_iter, settings.max_iter_in = iterations, MOST_INNER_ITERATIONS
    settings.verbose = False
    return settings


OF_FEW_ROWS, OF_ALL_ROWS = _settings(ROUGH, SOON), _settings(ACCURACY, MOST_ITERATIONS)


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
    """x (n,), the solver's status, and its iterations.

    carrying: indices of the rows whose multipliers are above `CARRIES`, the largest first.
    residual: by how much x violates the worst row, recomputed; negative if x violates none, infinite without an x.
    """

    x: Array
    status: str
    iterations: int
    carrying: Index = field(default_factory=lambda: np.zeros(0, dtype=np.int64))
    residual: float = np.inf

    @property
    def found(self) -> bool:
        return bool(np.isfinite(self.x).all())


NOTHING = np.array([np.nan])
INFEASIBLE = Solution(NOTHING, "ruled out", 0)  # of a program that need not be solved


def solve(program: QuadraticProgram) -> Solution:
    """Solve with a cold start: the answer depends on the problem alone, so a log can be replayed."""
    index, A, b = likely_rows(program.h, program.g, program.A, program.b, program.always, STEPS)
    few = _solved(QuadraticProgram(program.h, program.g, A, b), index, few=True)
    exact = _exact(program, few, few.carrying[:0] if few.status == INFEASIBLE_ROWS else few.carrying)
    if exact is None:
        solution = _solved(program, np.arange(len(program.b)))
        exact = _exact(program, solution, solution.carrying) or solution
    if not exact.found:
        return exact
    residual = float((program.A @ exact.x - program.b).max()) if len(program.b) else 0.0
    return Solution(exact.x, exact.status, exact.iterations, exact.carrying, residual)


def _exact(program: QuadraticProgram, solution: Solution, carrying: Index) -> Solution | None:
    """Return the exact solution of a program, or that there is none, from the rows that carry a solution of some rows.

    None if the method finds neither.
    """
    x, impossible = exact_solution(program.h, program.g, program.A, program.b, carrying)
    if np.isfinite(x).all():
        return Solution(x, SOLVED, solution.iterations, carrying)
    if impossible or solution.status == INFEASIBLE_ROWS:
        return Solution(NOTHING, INFEASIBLE_ROWS, solution.iterations, carrying)
    return None


def _solved(program: QuadraticProgram, index: Index, few: bool = False) -> Solution:
    """Solve with ProxQP. index (rows,): the number of each row among all rows, for `Solution.carrying`."""
    rows, n = program.A.shape
    qp = proxqp.dense.QP(n, 0, rows)
    parts = np.diag(program.h), program.g, None, None, program.A, None, program.b
    if few:
        qp.settings = OF_FEW_ROWS
        qp.init(*parts, compute_preconditioner=False, mu_in=FIRMNESS)
    else:
        qp.settings = OF_ALL_ROWS
        qp.init(*parts)
    qp.solve()
    results = qp.results
    x, status = np.array(results.x), results.info.status.name.removeprefix("PROXQP_").lower()
    carrying = carrying_rows(np.array(results.z), index, CARRIES)
    return Solution(x, status, int(results.info.iter), carrying)

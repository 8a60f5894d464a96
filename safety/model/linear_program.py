"""Linear programs that grow: HiGHS solves each one again from its last basis.

`scipy.optimize.linprog` has HiGHS, too, but it starts anew each time. Error bounds of one recording need thousands of
programs with about ten variables, for which SciPy's own work around the solver takes ten times as long as solving them.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from brakeline.errors import ErrorBoundError

Array = NDArray[np.float64]

OPTIMAL, UNBOUNDED, INFEASIBLE = "optimal", "unbounded", "infeasible"  # the states of a program
KNOWN = {  # the state for each of HiGHS's own
    "Optimal": OPTIMAL,
    "Unbounded": UNBOUNDED,
    "Primal infeasible or unbounded": UNBOUNDED,
    "Infeasible": INFEASIBLE,
}
NOT_FINITE = "a linear program holds NaN, infinity or a number that is too large"
TOLERANCE = 1e-9  # of constraints and of reduced costs
OPTIONS: dict[str, bool | int | float | str] = {
    "output_flag": False,
    "threads": 1,
    "presolve": "off",  # would forget the basis
    "primal_feasibility_tolerance": TOLERANCE,
    "dual_feasibility_tolerance": TOLERANCE,
}


class LinearProgram:
    """Minimise a cost over x (n,) with least <= x and low <= A x <= high. Rows of A are added, costs change.

    >>> program = LinearProgram(2, least=0.0)
    >>> program.add(np.array([[1.0, 2.0]]), np.array([2.0]), np.array([np.inf]))
    >>> program.minimise(np.array([1.0, 1.0]))
    ('optimal', array([0., 1.]))
    """

    def __init__(self, variables: int, least: float) -> None:
        """Begin without rows. least: lower bound of every variable; -inf: none."""
        from highspy import Highs  # here: a service does not need it

        self._solver, self._places = Highs(), np.arange(variables, dtype=np.int32)
        for name, value in OPTIONS.items():
            self._solver.setOptionValue(name, value)
        self._solver.addVars(variables, np.full(variables, least), np.full(variables, np.inf))

    def add(self, rows: Array, low: Array, high: Array) -> None:
        """Add constraints low (k,) <= rows (k, n) · x <= high (k,).

        Raises:
            ErrorBoundError: a number is NaN, infinite or too large. HiGHS would leave out the constraint.
        """
        from highspy import HighsStatus

        if not np.isfinite(rows).all():
            raise ErrorBoundError(NOT_FINITE)
        count, n = rows.shape
        starts, places = np.arange(0, rows.size, n, dtype=np.int32), np.tile(self._places, count)
        status = self._solver.addRows(count, low, high, rows.size, starts, places, rows.ravel())
        if status == HighsStatus.kError:
            raise ErrorBoundError(NOT_FINITE)

    def minimise(self, cost: Array) -> tuple[str, Array]:
        """Return the state of the program with this cost (n,), and x (n,), which has a meaning only if it is OPTIMAL.

        The state is UNBOUNDED, INFEASIBLE, or HiGHS's own word for anything else.

        Raises:
            ErrorBoundError: the cost is not finite.
        """
        if not np.isfinite(cost).all():
            raise ErrorBoundError("a linear program's cost holds NaN or infinity")
        self._solver.changeColsCost(len(self._places), self._places, cost)
        self._solver.run()
        if self._state() not in KNOWN.values():  # a basis may have become singular
            self._solver.clearSolver()
            self._solver.run()
        return self._state(), np.array(self._solver.getSolution().col_value)

    def _state(self) -> str:
        state = self._solver.modelStatusToString(self._solver.getModelStatus())
        return KNOWN.get(state, state)

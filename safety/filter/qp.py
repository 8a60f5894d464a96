"""The QP of one decision: the closest input whose tube stays inside the half-spaces (docs/method.md §4)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from brakeline.messaging.robot import Array
from brakeline.safety.filter.kernels import halfspace_kernels, qp_kernels, tube_kernels
from brakeline.safety.filter.plan_inputs import PlanInputs
from brakeline.safety.filter.qp_solver import QuadraticProgram
from brakeline.safety.filter.reachable_tube import Tube

Index = NDArray[np.int64]

# The QP's rows are tighter by this [m]. If a plan has one chosen input, a rounded answer then passes the exact check.
# If it has several, an answer also passes with the proposal in place of its first input (`AS_PROPOSED`).
ROW_TIGHTENING, ROW_TIGHTENING_SEVERAL = 1e-6, 2e-3
REGULARIZATION = 1e-4  # ε: weight of all other variables; with much less the solver needs thousands of iterations
ROUNDING = 1e-12  # of a unit row of W: a row with smaller entries for f does not depend on f


@dataclass(frozen=True)
class ConstraintRows:
    """Rows (3) of docs/method.md: `gradient z + spread m(z) <= bound`, where m(z) are the tube's magnitudes."""

    gradient: Array  # (rows, nz)
    spread: Array  # (rows, L+N+1) >= 0
    bound: Array  # (rows,) [m, or the unit of a limit]

    def support(self, tube: Tube, z: Array) -> Array:
        """Return the left side of the rows (rows,) for regressors z."""
        return np.asarray(self.gradient @ z + self.spread @ tube.magnitudes(z))


Center = tuple[Array, Array, Array]  # position (N, d, nz), offset (N, d), stretch (N,): see `halfspace_kernels`


class ObstacleRows:
    """Builds the rows (3) for one disc of the body, from matrices that it gathers once.

    Each obstacle gives 2N + 1 rows (`rows_per_obstacle`): N for the starts of the periods and N for their ends, both
    with the chord deviation of the period, and one for the last end with the stopping distance.
    """

    def __init__(self, directions: Array) -> None:
        """Gather the generators (N, d, L) of the disc's center, without the factors of `Tube.stretch`."""
        N, d, L = directions.shape
        at_start, at_end = np.arange(N), np.arange(1, N + 1)
        end = np.concatenate([at_start, at_end, [N]])
        directions = np.concatenate([np.zeros((1, d, L)), directions])[end]
        used = np.abs(directions).max(axis=1, initial=0.0) > 0.0  # in direct mode, each period has its own generators
        most = int(used.sum(axis=1).max(initial=0))
        period = np.concatenate([at_start, at_start, [N - 1]])
        extra = L + np.concatenate([at_start, at_start, [N]])  # the chord deviations, then the stopping distance
        columns = np.ascontiguousarray(np.argsort(~used, axis=1, kind="stable")[:, :most])
        end_directions = np.ascontiguousarray(np.take_along_axis(directions, columns[:, None, :], axis=2))
        self.ends: tuple[Index, Index, Array, Index, Index] = end, period, end_directions, columns, extra
        self._sizes = L + N + 1

    def rows(self, center: Center, normals: Array, offsets: Array, widening: float) -> ConstraintRows:
        """Return rows for half-spaces `a·p <= b` in the robot's frame, a (n, N, d), b (n, N)."""
        parts = *center, *self.ends
        return ConstraintRows(*halfspace_kernels.rows(normals, offsets, *parts, self._sizes, widening))

    def slack(self, center: Center, normals: Array, offsets: Array, sizes: Array, z: Array) -> Array:
        """Return `bound - support` of these rows for regressors z with magnitudes `sizes` (L+N+1,).

        This is faster than building the rows: there may be hundreds, each as wide as the tube has generators.
        """
        parts = *center, *self.ends
        return halfspace_kernels.slack(normals, offsets, *parts, sizes, z)


class QPBuilder:
    """Builds the QP of docs/method.md §4 from matrices that it computes once. `qp_solver` solves it.

    The variables are [f; t]: free inputs f, and slacks t >= |W z| for the rows of W that depend on f:

        min ‖f_0 - r‖² + REGULARIZATION (‖f_1 ..‖² + ‖t‖²)      each in units of its range
        s.t. gradient z + spread (M t + ...) <= bound,   ±(W z) <= t,   low <= f <= high,   |f_k - f_{k-1}| <= slew

    Variables are in units of their range (`scale`) and rows have unit length: without that, one problem in a hundred
    took ten milliseconds.
    """

    def __init__(self, allowed: PlanInputs, tube: Tube) -> None:
        self.robot = robot = allowed.robot
        self.tube = tube
        m, steps = robot.action_dim, robot.free_steps - robot.committed_steps
        free = steps * m
        self.tightening = ROW_TIGHTENING if steps == 1 else ROW_TIGHTENING_SEVERAL
        self.known = tube.position.shape[2] - free  # length of z_0
        self.free = free
        moving = np.abs(tube.W[:, self.known :]).max(1, initial=0.0) > ROUNDING
        whole = np.ascontiguousarray
        W_t, self.M_t = tube.W[moving], whole(tube.M[:, moving])
        self.W_c, self.M_c = whole(tube.W[~moving][:, : self.known]), whole(tube.M[:, ~moving])
        self._known_sizes = whole(self.W_c.T), whole(self.M_c.T), tube.m_0
        self.W_known, self.W_f = whole(W_t[:, : self.known]), whole(W_t[:, self.known :])
        self.abs_W_f = np.abs(self.W_f)
        atoms = len(W_t)
        width = np.tile(allowed.width, steps)
        self.scale = np.concatenate([width, self.abs_W_f @ width])
        self.h = np.full(free + atoms, REGULARIZATION)
        self.h[:m] = 1.0
        above = np.hstack([self.W_f, -np.eye(atoms)])
        below = np.hstack([-self.W_f, -np.eye(atoms)])
        inputs = np.hstack([np.eye(free), np.zeros((free, atoms))])
        difference = np.hstack([np.eye(free) - np.eye(free, k=-m), np.zeros((free, atoms))])
        limited = np.tile(np.isfinite(robot.action_slew), steps)
        difference = difference[limited]
        fixed = np.vstack([above, below, inputs, -inputs, difference, -difference]) * self.scale
        self.length = np.linalg.norm(fixed, axis=1)
        self.fixed = fixed / self.length[:, None]
        self.limited = limited
        self.low, self.high = allowed.low, allowed.high
        # Largest change of each free input against the input in force.
        self.change = np.arange(1.0, steps + 1.0)[:, None] * np.asarray(robot.action_slew)
        self.slew = np.tile(robot.action_slew, steps)[limited]
        self.box = np.concatenate([np.tile(allowed.high, steps), -np.tile(allowed.low, steps)])
        # The bounds of the fixed rows are affine in z_0: the first free input changes from the input in force.
        first = np.eye(free, m)[limited] @ np.eye(m, self.known, k=self.known - m)
        slope = np.vstack([-self.W_known, self.W_known, np.zeros((2 * free, self.known)), first, -first])
        bound = np.concatenate([np.zeros(2 * atoms), self.box, self.slew, self.slew])
        self._fixed_rows = whole(self.fixed), bound / self.length, whole(slope / self.length[:, None])

    def program(self, rows: ConstraintRows, z_0: Array, proposal: Array) -> QuadraticProgram | None:
        """Build the QP for known regressors z_0 (known,) and a proposal r (m,); None if a row rules out every input.

        Over all inputs within bounds and slew, the left side of a row has a smallest and a largest value. If the
        smallest violates the bound, no input meets the row. If the largest meets it, the row is left out: with many
        obstacles, nearly all rows are.
        """
        m = self.robot.action_dim
        inputs = self.reachable(z_0[-m:])
        constant = tube_kernels.magnitudes(*self._known_sizes, z_0)  # what no free input changes
        atoms = qp_kernels.atom_range(self.W_known, self.W_f, z_0, *inputs)
        parts = constant, self.M_t, *inputs, atoms, self.scale, self.tightening, *self._fixed_rows
        count, A, b = qp_kernels.presolved_rows(rows.gradient, rows.spread, rows.bound, z_0, *parts)
        if count < 0:
            return None
        g = np.zeros(len(self.h))
        g[:m] = -proposal / self.scale[:m]
        return QuadraticProgram(self.h, g, A[:count], b[:count], len(self.fixed))

    def reachable(self, before: Array) -> tuple[Array, Array]:
        """Return center and half-widths (F·m,) of the free inputs within bounds and slew after `before` (m,)."""
        return qp_kernels.reachable(self.low, self.high, self.change, before)

    def inputs(self, x: Array) -> Array:
        """Return the free inputs (F·m,) of a solution x."""
        return np.asarray(x[: self.free] * self.scale[: self.free])

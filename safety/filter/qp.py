"""The QP of one decision: the closest input whose tube stays inside the half-spaces (docs/method.md §4)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from brakeline.messaging.robot import Robot
from brakeline.safety.filter.kernels import halfspace_kernels
from brakeline.safety.filter.qp_solver import QuadraticProgram
from brakeline.safety.filter.reachable_tube import Tube

Array = NDArray[np.float64]

SHARPEN = 1e-6  # m; the QP's rows are this much tighter, so that its answer's rounding passes the exact check
REGULAR = 1e-4  # weight of what the objective leaves free; much less and the solver needs thousands of iterations
ROUNDING = 1e-12  # of a unit row of W: an atom that depends on the inputs no more than this does not


@dataclass(frozen=True)
class ConstraintRows:
    """A half-space for every end of every period: support of the tube in its normal, `gradient z + spread m(z)`.

    gradient (rows, nz); spread (rows, L+N+1) >= 0; bound (rows,). keep (rows,): the factor of
    the clearance margin in a row: 1 if the row is about an obstacle, 0 if it is about a limit in other units.
    """

    gradient: Array
    spread: Array
    bound: Array
    keep: Array

    def support(self, tube: Tube, z: Array) -> Array:
        return np.asarray(self.gradient @ z + self.spread @ tube.magnitudes(z))


class ObstacleRows:
    """The parts of a tube that rows about obstacles are made from, gathered once, for one disc of the body.

    Per obstacle there are 2N+1 rows: period k's half-space at the period's start and at its end, both with the bulge
    of that period, and the last one again with the stop latch.
    """

    def __init__(self, position: Array, directions: Array) -> None:
        """position (N, d, nz), directions (N, d, L): of a point of the body."""
        N, d, nz = position.shape
        L = directions.shape[2]
        at_start, at_end = np.arange(N), np.arange(1, N + 1)
        ends = np.concatenate([at_start, at_end, [N]])
        directions = np.concatenate([np.zeros((1, d, L)), directions])[ends]
        used = np.abs(directions).max(axis=1, initial=0.0) > 0.0  # a generator may be a period's own
        most = int(used.sum(axis=1).max(initial=0))
        period, chord_deviation = (
            np.concatenate([at_start, at_start, [N - 1]]),
            L + np.concatenate([at_start, at_start, [N]]),
        )
        ways = np.ascontiguousarray(np.concatenate([np.zeros((1, d, nz)), position])[ends])
        columns = np.ascontiguousarray(np.argsort(~used, axis=1, kind="stable")[:, :most])
        spans = np.ascontiguousarray(np.take_along_axis(directions, columns[:, None, :], axis=2))
        self.parts = period, ways, spans, columns, chord_deviation
        self.sizes = L + N + 1

    def rows(self, normals: Array, offsets: Array) -> ConstraintRows:
        """Rows for half-spaces `a·p <= b` in the frame of now, a (n, N, d), b (n, N)."""
        gradient, spread, bound = halfspace_kernels.rows(normals, offsets, *self.parts, self.sizes)
        return ConstraintRows(gradient, spread, bound, np.ones(len(bound)))

    def slack(self, normals: Array, offsets: Array, sizes: Array, z: Array) -> Array:
        """What these rows leave, `bound - support`, of the tube with magnitudes `sizes` (L+N+1,) under regressors z,
        without the rows themselves: there are hundreds, as wide as the tube has generators."""
        return halfspace_kernels.slack(normals, offsets, *self.parts, sizes, z)


class QPBuilder:
    """Builds the QP of a decision; everything that does not change from call to call is kept.

    Variables [free inputs f; t], t the atoms |W z| that depend on f, as epigraphs:

        min ‖f_0 - r‖² + REGULAR (‖f_1 ..‖² + ‖t‖²)      each in units of its range
        s.t. gradient z + spread (M t + ...) <= bound,   ±(W z) <= t,   low <= f <= high,   |f_k - f_{k-1}| <= slew

    Variables are scaled by `scale` and rows to unit length: unscaled, one problem in a hundred took ten milliseconds.
    """

    def __init__(self, robot: Robot, tube: Tube) -> None:
        self.robot = robot
        self.tube = tube
        m, steps = robot.action_dim, robot.free_steps - robot.committed_steps
        free = steps * m
        self.known = tube.position.shape[2] - free  # length of z_0
        self.free = free
        moving = np.abs(tube.W[:, self.known :]).max(1, initial=0.0) > ROUNDING
        whole = np.ascontiguousarray
        W_t, self.M_t = tube.W[moving], whole(tube.M[:, moving])
        self.W_c, self.M_c = whole(tube.W[~moving][:, : self.known]), whole(tube.M[:, ~moving])
        self.W_known, self.W_f = whole(W_t[:, : self.known]), whole(W_t[:, self.known :])
        self.give = np.abs(self.W_f)
        atoms = len(W_t)
        width = np.tile(robot.high() - robot.low(), steps)
        self.scale = np.concatenate([width, self.give @ width])
        self.h = np.full(free + atoms, REGULAR)
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
        self.low, self.high = robot.low(), robot.high()
        self.way = np.arange(1.0, steps + 1.0)[:, None] * np.asarray(
            robot.action_slew
        )  # of the input, until each free one
        self.slew = np.tile(robot.action_slew, steps)[limited]
        self.box = np.concatenate([np.tile(robot.high(), steps), -np.tile(robot.low(), steps)])

    def program(self, rows: ConstraintRows, z_0: Array, proposal: Array) -> QuadraticProgram | None:
        """The QP for known regressors z_0 (known,) and a proposal r (m,); None if some row rules out every input.

        Over the box of inputs that bounds and slew leave, each row's support has a least and a largest value: one
        whose least is beyond its bound can't be met, one whose largest is within it need not be looked at. With many
        obstacles that is nearly all of them.
        """
        m = self.robot.action_dim
        constant = self.M_c @ np.abs(self.W_c @ z_0) + self.tube.m_0
        offset = self.W_known @ z_0
        center, radius = self.reachable(z_0[-m:])
        atom, give = offset + self.W_f @ center, self.give @ radius
        atoms = np.stack([np.maximum(np.abs(atom) - give, 0.0), np.abs(atom) + give])
        count, A, b = halfspace_kernels.presolve_rows(
            rows.gradient, rows.spread, rows.bound, z_0, constant, self.M_t, center, radius, atoms, self.scale, SHARPEN
        )
        if count < 0:
            return None
        first = np.zeros(self.free)
        first[:m] = z_0[-m:]
        first = first[self.limited]
        g = np.zeros(len(self.h))
        g[:m] = -proposal / self.scale[:m]
        fixed = np.concatenate([-offset, offset, self.box, self.slew + first, self.slew - first]) / self.length
        return QuadraticProgram(
            self.h, g, np.vstack([A[:count], self.fixed]), np.concatenate([b[:count], fixed]), len(fixed)
        )

    def reachable(self, before: Array) -> tuple[Array, Array]:
        """Center and half-widths (F·m,) of what bounds and slew leave to the free inputs after `before` (m,)."""
        return halfspace_kernels.reachable(self.low, self.high, self.way, before)

    def inputs(self, x: Array) -> Array:
        """The free inputs (F·m,) in a solution."""
        return np.asarray(x[: self.free] * self.scale[: self.free])

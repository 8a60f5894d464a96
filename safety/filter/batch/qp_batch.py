"""Build and solve the QPs of a batch (docs/method.md §4). The last axis of each array is the batch.

This module does for many robots what `QPBuilder` and `qp_kernels.presolved_rows` do for one. The filter verifies its
answers, as those of any solver.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from brakeline.safety.filter.batch.constraint_batch import ConstraintBatch, PlanBatch, SceneBatch
from brakeline.safety.filter.batch.dual_active_set import BatchSolution, solve_batch
from brakeline.safety.filter.batch.obstacle_arrays import Array
from brakeline.safety.filter.qp import ROW_TIGHTENING, QPBuilder

ROUNDING = 1e-9  # m: for values nearer to each other, the order of the sums may decide their comparison


class RowBatch(NamedTuple):
    """Rows that are affine in the free inputs f and the slacks t: `gradient f + spread t <= bound`.

    Attributes:
        gradient (F, R, B), spread (q, R, B) >= 0, bound (R, B) [m].
    """

    gradient: Array
    spread: Array
    bound: Array


class QPBatch:
    """Builds and solves the QPs of many robots with the matrices of a `QPBuilder`."""

    def __init__(self, builder: QPBuilder, constraints: ConstraintBatch, constant: Any, xp: Any) -> None:
        self._xp, self._constraints = xp, constraints
        self.free, self.known, self._m = builder.free, builder.known, builder.robot.action_dim
        self._atoms = len(builder.W_f)
        self._W_c, self._M_c = constant(builder.W_c), constant(builder.M_c)
        self._M_t, self._m_0 = constant(builder.M_t), constant(builder.tube.m_0[:, None])
        self._W_known, self._W_f = constant(builder.W_known), constant(builder.W_f)
        self._abs_W_f, self._scale = constant(builder.abs_W_f), constant(builder.scale[:, None])
        self._h, self._fixed = constant(builder.h[:, None]), constant(builder.fixed[..., None])
        self._length = constant(builder.length[:, None])
        self._low, self._high = constant(builder.low[None, :, None]), constant(builder.high[None, :, None])
        self._change = constant(builder.change[..., None])
        self._box, self._slew = constant(builder.box[:, None]), constant(builder.slew[:, None])
        self._tightening = builder.tightening
        first = np.zeros((self.free, self._m))  # the first free inputs change from the input in force
        first[: self._m] = np.eye(self._m)
        self._first = constant(first[builder.limited])

    def rows(self, scene: SceneBatch, plan: PlanBatch, z_0: Array) -> RowBatch:
        """Return the rows of all half-spaces, linearised at plans. z_0 (known, B): the known regressors."""
        xp, c = self._xp, self._constraints
        slopes = c.tube.gradient(plan.z, self.free)  # (N, C, F, B or 1)
        outputs = plan.path.outputs
        f = plan.z[self.known :]
        fixed = outputs - sum(slopes[:, :, j] * f[j] for j in range(self.free))  # at f = 0
        # (L+N+1, B): the part of the magnitudes that no free input changes
        constant = self._M_c @ xp.abs(self._W_c @ z_0) + self._m_0
        gradients, spreads, bounds = [], [], []
        for (*_, first, ends), planes in zip(c.discs, plan.planes, strict=True):
            normals = [ends.at_ends(part) for part in planes.turned]  # (E, K, B)
            axes = range(c.d)
            bound = ends.at_ends(planes.offsets)
            bound = bound - sum(normals[i] * ends.places(fixed[:, first + i])[:, None] for i in axes)
            own = [ends.places(slopes[:, first + i])[:, :, None] for i in axes]  # (E, F, 1, B)
            gradient = [sum(normals[i] * own[i][:, j] for i in axes) for j in range(self.free)]
            alongs = ends.alongs(normals, plan.path.stretch)
            # A row subtracts the magnitudes of its generators and its chord deviation, times these factors.
            factors = [*(along * scene.widening for along in alongs), scene.widening]
            magnitudes = [*zip(factors, (*ends.columns, ends.extra), strict=True)]
            bound = bound - sum(w * xp.take(constant, which, axis=0)[:, None] for w, which in magnitudes)
            shape = bound.shape
            spread = []
            for t in range(self._atoms):
                parts = (w * xp.take(self._M_t[:, t], which, axis=0)[:, None, None] for w, which in magnitudes)
                spread.append(xp.broadcast_to(sum(parts), shape))
            flat = (-1, shape[-1])
            gradients.append(xp.stack([xp.reshape(part, flat) for part in gradient]))
            spreads.append(xp.stack([xp.reshape(part, flat) for part in spread]))
            bounds.append(xp.reshape(bound, flat))
        if len(bounds) == 1:
            return RowBatch(gradients[0], spreads[0], bounds[0])
        return RowBatch(xp.concat(gradients, axis=1), xp.concat(spreads, axis=1), xp.concat(bounds))

    def reachable(self, before: Array) -> tuple[Array, Array]:
        """Return center and half-widths (F, B) of the free inputs within bounds and slew after `before` (m, B)."""
        xp = self._xp
        least = xp.maximum(before - self._change, xp.broadcast_to(self._low, (1, *before.shape)))
        most = xp.minimum(before + self._change, xp.broadcast_to(self._high, (1, *before.shape)))
        flat = (-1, before.shape[1])
        return xp.reshape(0.5 * (least + most), flat), xp.reshape(0.5 * (most - least), flat)

    def solve(self, rows: RowBatch, z_0: Array, proposal: Array) -> tuple[Array, Array, Array, Array]:
        """Solve the QPs of rows for known regressors z_0 (known, B) and proposals r (m, B).

        Returns:
            Free inputs (F, B), whether they solve the QP (B,), whether no input meets the rows (B,), steps (B,).
            If both are false in a lane, the solver found no answer.
        """
        xp = self._xp
        before = z_0[self.known - self._m :]
        center, radius = self.reachable(before)
        offset = self._W_known @ z_0
        atom, deviation = offset + self._W_f @ center, self._abs_W_f @ radius
        least_t = xp.maximum(xp.abs(atom) - deviation, xp.zeros_like(atom))
        most_t = xp.abs(atom) + deviation
        bound = rows.bound - self._tightening
        # The least and the largest value of each row, over all inputs within bounds and slew.
        least, most = xp.zeros_like(bound), xp.zeros_like(bound)
        for j in range(self.free):
            middle, aside = rows.gradient[j] * center[j], xp.abs(rows.gradient[j]) * radius[j]
            least, most = least + middle - aside, most + middle + aside
        for t in range(self._atoms):
            least, most = least + rows.spread[t] * least_t[t], most + rows.spread[t] * most_t[t]
        over = least - bound
        ruled_out = xp.any(over > ROUNDING, axis=0)
        unsure = ~ruled_out & xp.any(over > -ROUNDING, axis=0)
        A, b = self._selected(rows, bound, most > bound)
        changed = self._first @ before
        fixed = xp.concat(
            [
                -offset,
                offset,
                xp.broadcast_to(self._box, (self._box.shape[0], before.shape[1])),
                self._slew + changed,
                self._slew - changed,
            ]
        )
        A = xp.concat([xp.broadcast_to(self._fixed, (*self._fixed.shape[:2], before.shape[1])), A])
        b = xp.concat([fixed / self._length, b])
        g = xp.zeros((self._h.shape[0], before.shape[1]), dtype=b.dtype, device=b.device)
        g[: self._m] = -proposal / self._scale[: self._m]
        atom = offset + self._W_f[:, : self._m] @ proposal
        index = xp.arange(self._atoms, device=b.device)[:, None]
        solution: BatchSolution = solve_batch(xp, self._h, g, A, b, xp.where(atom > 0.0, index, index + self._atoms))
        solved = solution.solved & ~ruled_out & ~unsure
        impossible = ruled_out | (solution.infeasible & ~unsure)
        return solution.x[: self.free] * self._scale[: self.free], solved, impossible, solution.steps

    def _selected(self, rows: RowBatch, bound: Array, selected: Array) -> tuple[Array, Array]:
        """Return the selected rows (R, B) as A (r, n, B) and b (r, B) in scaled unknowns, each of unit length.

        r is the largest number of such rows in a lane. In a lane with fewer, the other rows are 0 <= 1.
        """
        xp = self._xp
        count = int(xp.max(xp.sum(xp.astype(selected, xp.int64), axis=0))) if selected.shape[0] else 0
        order = xp.argsort(xp.astype(~selected, xp.int8), axis=0, stable=True)[:count]
        parts = [rows.gradient[j] for j in range(self.free)] + [rows.spread[t] for t in range(self._atoms)]
        scaled = [xp.take_along_axis(part, order, axis=0) * self._scale[j] for j, part in enumerate(parts)]
        used = xp.take_along_axis(selected, order, axis=0)
        square = sum(part * part for part in scaled)
        length = xp.maximum(xp.sqrt(square), xp.full_like(square, ROW_TIGHTENING))
        A = xp.where(used[:, None], xp.stack(scaled, axis=1) / length[:, None], 0.0)
        b = xp.where(used, xp.take_along_axis(bound, order, axis=0) / length, 1.0)
        return A, b

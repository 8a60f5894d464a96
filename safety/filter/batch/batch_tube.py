"""The tubes of a batch of plans (docs/method.md §2, §13), for linear tubes and for rollouts; the batch is last.

A path holds the predicted coordinates after each period, in the frame of the start: the position, then the further
coordinates that the tube keeps.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from brakeline.safety.filter.batch.obstacle_arrays import Array
from brakeline.safety.filter.reachable_tube import RolloutTube, Tube


@dataclass(frozen=True)
class PathBatch:
    """The predicted centers of a batch of plans."""

    outputs: Array  # (N, C, B): predicted coordinates after each period
    stretch: Array  # (N, B) or (N, 1): factors on the sets
    first: Array  # (n, B) or (n, 1): what a rollout adds to the prediction of all coordinates after one period


class TubeBatch:
    """The tube of a model set, with its matrices in a namespace and on a device.

    Attributes:
        linear: the centers are linear in z, so their gradient is the same for all plans.
        generators: L. rollout: the rollout of its predictor; None if it is linear.
    """

    def __init__(self, tube: Tube, state_dim: int, constant: Any, xp: Any) -> None:
        """Prepare a tube. constant: a function that brings an array to the namespace and device."""
        self._xp, self.linear, self.generators = xp, not isinstance(tube, RolloutTube), tube.generators
        self._W, self._M, self._m_0 = constant(tube.W), constant(tube.M), constant(tube.m_0[:, None])
        maps = np.concatenate([tube.position, tube.more], axis=1)  # (N, C, nz)
        self._shape = maps.shape[:2]
        self._maps = constant(maps.reshape(-1, maps.shape[2]))
        offset = np.concatenate([tube.offset, tube.more_offset], axis=1)
        self._offset = constant(offset[..., None])
        self._gradient = constant(maps[..., None])
        self._unstretched, self._unmoved = constant(np.ones((tube.horizon, 1))), constant(np.zeros((state_dim, 1)))
        self.rollout = RolloutBatch(tube, constant, xp) if isinstance(tube, RolloutTube) else None

    def sizes(self, z: Array, widening: Array) -> Array:
        """Return the magnitudes m(z) (L+N+1, B), times the widening (B,), for regressors z (nz, B)."""
        return (self._M @ self._xp.abs(self._W @ z) + self._m_0) * widening

    def path(self, z: Array) -> PathBatch:
        """Return the predicted centers for regressors z (nz, B)."""
        if self.rollout is not None:
            return self.rollout.path(z)
        outputs = self._xp.reshape(self._maps @ z, (*self._shape, z.shape[1])) + self._offset
        return PathBatch(outputs, self._unstretched, self._unmoved)

    def gradient(self, z: Array, free: int) -> Array:
        """Return the derivative (N, C, free, B or 1) of the centers by the last `free` regressors, at z (nz, B)."""
        if self.rollout is not None:
            return self.rollout.gradient(z, free)
        return self._gradient[:, :, self._gradient.shape[2] - free :]


class RolloutBatch:
    """The rollout of a one-step predictor over a batch of plans, and its gradient: see `rollout_kernels`."""

    def __init__(self, tube: RolloutTube, constant: Any, xp: Any) -> None:
        robot, one_step = tube.robot, tube.one_step
        C, scale, saturations, terms, others, heading, arms, d, inputs = one_step.arguments(robot)
        self._xp, self._heading, self._d, self._inputs, self._n = xp, heading, d, inputs, len(C)
        self._others, self._arms, self._weight = others.tolist(), arms.tolist(), one_step.weight
        self._written = [*range(d), *tube.further]
        self._C, self._scale, self._root = constant(C), constant(scale[:, None]), constant(one_step.root)
        self._terms = [constant(slot) for slot in terms.T]
        self._bent = [(int(a), int(b), float(width)) for a, b, width in saturations]
        self._T, self._horizon = constant(tube.inputs_of), tube.horizon
        primitives = 1 + len(scale) + len(saturations)
        # By slot: C times the map from features to the primitive in that slot; the constant 1 has no derivative.
        chosen = np.arange(1, primitives)[:, None, None] == terms.T[None]  # (P, 4, F)
        by_slot = C[:, None, None] * chosen  # (n, P, 4, F)
        self._by_slot = [constant(by_slot[:, :, slot].reshape(-1, len(terms))) for slot in range(4)]

    def path(self, z: Array) -> PathBatch:
        """Roll out the plans with regressors z (nz, B)."""
        outputs, stretch = self.windows(self._T @ z)
        return PathBatch(outputs[:, self._written], stretch, outputs[0, : self._n])

    def windows(self, window: Array) -> tuple[Array, Array]:
        """Roll out windows (r + m + N·m, B) of inputs; return the outputs (N, n + D·d, B), and the factors (N, B)."""
        xp, total, rows, stretch = self._xp, 0.0, [], []
        for k, features, _, _, row in self._periods(window):
            total = total + features
            along = self._root @ total
            stretch.append(xp.sqrt(1.0 + self._weight * (xp.sum(along * along, axis=0) / (k + 1))))
            rows.append(xp.stack(row))
        return xp.stack(rows), xp.stack(stretch)

    def _periods(self, window: Array) -> Any:
        """Yield, for each period: its index, the features, the primitives, the outputs y (n, B), and a row of outputs.

        The row (n + D·d) is a list of arrays (B,): see `rollout_kernels.rollout`.
        """
        xp, r, m, d = self._xp, len(self._others), self._inputs, self._d
        nothing = xp.zeros_like(window[0])
        s, angle, place = window[:r], nothing, [nothing] * d
        for k in range(self._horizon):
            now = r + (k + 1) * m
            primitives = self._primitives(xp.concat([s, window[now : now + m], window[now - m : now]]))
            p = [xp.take(primitives, index, axis=0) for index in self._terms]
            features = p[0] * p[1] * p[2] * p[3]
            y = self._C @ features
            row = [y[i] for i in range(self._n)]
            moved = row[:d]
            if self._heading >= 0:
                cos, sin = xp.cos(angle), xp.sin(angle)
                moved = [cos * y[0] - sin * y[1], sin * y[0] + cos * y[1], *moved[2:]]
                angle = angle + y[self._heading]
                row[self._heading] = angle
            place = [a + b for a, b in zip(place, moved, strict=True)]
            row[:d] = place
            if self._heading >= 0:
                cos, sin = xp.cos(angle), xp.sin(angle)
                for arm in self._arms:
                    swung = cos * arm[0] - sin * arm[1] - arm[0], sin * arm[0] + cos * arm[1] - arm[1]
                    row += [place[0] + swung[0], place[1] + swung[1], *place[2:]]
            yield k, features, (primitives, p), y, row
            s = xp.stack([y[i] for i in self._others])

    def _primitives(self, v: Array) -> Array:
        """Return [1; v / scale; saturations] (P, B) for variables v (V, B)."""
        xp, bent = self._xp, []
        for a, b, width in self._bent:
            bent.append(xp.tanh((v[a] - v[b] if b >= 0 else v[a]) / width)[None])
        return xp.concat([xp.ones_like(v[:1]), v / self._scale, *bent])

    def gradient(self, z: Array, free: int) -> Array:
        """Return the derivative (N, C, free, B) of the outputs by the last `free` regressors, at z (nz, B)."""
        xp, r, m, d, turned = self._xp, len(self._others), self._inputs, self._d, self._heading >= 0
        B = z.shape[1]
        T = self._T[:, self._T.shape[1] - free :][:, :, None]
        ds = xp.broadcast_to(T[:r], (r, free, B))
        dangle, angle = xp.zeros((free, B), dtype=z.dtype, device=z.device), xp.zeros_like(z[0])
        dplace = [xp.zeros_like(dangle) for _ in range(d)]
        gradients = []
        for k, _, (primitives, p), y, row in self._periods(self._T @ z):
            now = r + (k + 1) * m
            inputs = xp.concat([T[now : now + m], T[now - m : now]])
            dv = xp.concat([ds, xp.broadcast_to(inputs, (2 * m, free, B))])
            partial = self._partials(primitives, p)
            dy = partial[:, 0, None] * dv[0]
            for j in range(1, dv.shape[0]):
                dy = dy + partial[:, j, None] * dv[j]
            drow = [dy[i] for i in range(self._n)]
            dmoved = drow[:d]
            if turned:
                cos, sin = xp.cos(angle), xp.sin(angle)
                east, north = cos * y[0] - sin * y[1], sin * y[0] + cos * y[1]
                dmoved = [
                    cos * dy[0] - sin * dy[1] - north * dangle,
                    sin * dy[0] + cos * dy[1] + east * dangle,
                    *dmoved[2:],
                ]
                dangle, angle = dangle + dy[self._heading], row[self._heading]
                drow[self._heading] = dangle
            dplace = [a + b for a, b in zip(dplace, dmoved, strict=True)]
            drow[:d] = dplace
            if turned:
                cos, sin = xp.cos(angle), xp.sin(angle)
                for arm in self._arms:
                    east, north = cos * arm[0] - sin * arm[1], sin * arm[0] + cos * arm[1]
                    drow += [dplace[0] - north * dangle, dplace[1] + east * dangle, *dplace[2:]]
            gradients.append(xp.stack([drow[i] for i in self._written]))
            ds = xp.stack([dy[i] for i in self._others])
        return xp.stack(gradients)

    def _partials(self, primitives: Array, p: list[Array]) -> Array:
        """Return the derivatives (n, V, B) of the outputs y by the variables."""
        xp, n, V = self._xp, self._n, self._scale.shape[0]
        slopes: Array = 0.0
        for slot in range(4):
            slopes = slopes + self._by_slot[slot] @ (p[slot - 1] * p[slot - 2] * p[slot - 3])
        slopes = xp.reshape(slopes, (n, -1, primitives.shape[1]))
        partial = slopes[:, :V] / self._scale
        for e, (a, b, width) in enumerate(self._bent):
            bent = primitives[1 + V + e]
            slope = slopes[:, V + e] * (1.0 - bent * bent) / width
            partial[:, a] += slope
            if b >= 0:
                partial[:, b] -= slope
        return partial

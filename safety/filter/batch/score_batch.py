"""The scores of a batch of windows that have ended: `WindowScore` for many robots (docs/method.md §15)."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from brakeline.safety.filter.batch.batch_tube import RolloutBatch
from brakeline.safety.filter.batch.obstacle_arrays import Array, TurnBatch
from brakeline.safety.model.model_set import ModelSet, scored_coordinates


class ScoreBatch:
    """Scores windows by the sets that a model set of mode one-step states for them, without widening."""

    def __init__(self, model: ModelSet, rollout: RolloutBatch, constant: Any, xp: Any) -> None:
        robot = model.robot
        self._xp, self._rollout, self._n, self._d = xp, rollout, robot.state_dim, robot.position_dim
        self._heading, self._regressor = robot.heading, list(robot.regressor)
        self._arms = [disc.at for disc in robot.body if disc.arm > 0.0]
        kappa, M, w = (np.array([getattr(step, name) for step in model.steps]) for name in ("kappa", "M", "w"))
        self._W, self._M, self._kappa = (
            constant(model.first.W),
            constant(M.reshape(-1, M.shape[2])),
            constant(kappa.reshape(-1, kappa.shape[2])),
        )
        self._w = constant(w[..., None])
        counts = np.zeros((2, *w.shape))
        counts[:, :, scored_coordinates(robot)] = 1.0
        counts[0, 0] = 1.0
        self._counts = [constant(one[..., None]) for one in counts]  # of all errors, and of scored coordinates alone

    def __call__(self, states: Array, inputs: Array, state: Array) -> tuple[Array, Array]:
        """Return the largest ratio of an error to its set (B,), NaN if one is NaN: see `WindowScore`.

        states (N, n, B), inputs (N + 1, m, B): of the past periods. state (n, B): measured now.
        """
        xp, n, d, first = self._xp, self._n, self._d, states[0]
        speeds = xp.stack([first[i] for i in self._regressor])
        window = xp.concat([speeds, xp.reshape(inputs, (-1, inputs.shape[2]))])
        predicted, stretch = self._rollout.windows(window)  # (N, n + d·discs, B)
        after = xp.concat([states[1:], state[None]])
        moved = [after[:, i] - first[i] if i < d else after[:, i] for i in range(n)]
        if self._heading is not None:
            moved = TurnBatch(xp.cos(first[self._heading]), xp.sin(first[self._heading])).to_robot(moved)
            turned = moved[self._heading] - first[self._heading]
            turned = moved[self._heading] = xp.remainder(turned + math.pi, math.tau) - math.pi
            turn = TurnBatch(xp.cos(turned), xp.sin(turned))
            for at in self._arms:
                swung = turn.to_world([*at])
                moved += [moved[axis] + swung[axis] - at[axis] for axis in range(d)]
        off = xp.abs(xp.stack(moved, axis=1) - predicted)
        N, count = off.shape[:2]
        width = self._M @ xp.abs(self._W @ window) + self._kappa @ xp.abs(window)
        width = (xp.reshape(width, (N, count, -1)) + self._w) * stretch[:, None]
        share = xp.where(off != 0.0, off / width, 0.0)
        score, of_plan = (
            xp.max(xp.reshape(xp.where(counts > 0.0, share, 0.0), (N * count, -1)), axis=0) for counts in self._counts
        )
        return score, xp.where(xp.isnan(score), score, of_plan)

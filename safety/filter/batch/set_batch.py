"""The predicted sets of a batch: where the next measured state of each plan may lie."""

from __future__ import annotations

from typing import Any

import numpy as np

from brakeline.safety.filter.batch.constraint_batch import ConstraintBatch, PlanBatch, SceneBatch
from brakeline.safety.filter.batch.obstacle_arrays import Array
from brakeline.safety.filter.reachable_tube import Tube
from brakeline.safety.model.model_set import ModelSet, deciding_coordinates


class SetBatch:
    """The sets of plans of one kind: of all plans, or of those that turn in place."""

    def __init__(self, constraints: ConstraintBatch, model: ModelSet, tube: Tube, constant: Any, xp: Any) -> None:
        self.constraints = constraints
        robot, nz, first = model.robot, tube.position.shape[2], model.first
        n = robot.state_dim
        self._xp, self._d = xp, robot.position_dim
        self._regressor = constant(model.first_regressor(np.eye(nz)).T)
        self._C, self._W, self._M = constant(first.C[:n]), constant(first.W), constant(first.M)
        self._kappa, self._w = constant(first.kappa), constant(first.w[:, None])
        self._widths = constant(np.abs(first.generators[:n]))
        self._decide = constant(deciding_coordinates(robot)[:, None].astype(float)) > 0.5

    def of_next_state(self, scene: SceneBatch, plan: PlanBatch) -> tuple[Array, Array]:
        """Return the predicted sets of the next measured states: `TubeConstraints.predict` for a batch.

        They are centers and half-widths (n, B), the position in the world; the heading is the change of heading.
        """
        xp, d = self._xp, self._d
        window = self._regressor @ plan.z
        sizes = self._M @ xp.abs(self._W @ window) + self._w + self._kappa @ xp.abs(window)
        factors = xp.where(self._decide, scene.asked_widening, scene.state_widening)
        half = (self._widths @ sizes) * (factors * plan.path.stretch[0])
        center = plan.path.first + self._C @ window
        moved = scene.turn.to_world([center[i] for i in range(d)])
        center[:d] = xp.stack([a + b for a, b in zip(scene.start, moved, strict=True)])
        return center, half

"""What all rivals share: what they cannot decide on is refused, what is not finite is braked, nothing is verified."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from time import perf_counter_ns
from typing import Any

import numpy as np

from brakeline.messaging.robot import Array
from brakeline.safety.filter.backup_plan import NO_PREDICTION, brake, braking_plan
from brakeline.safety.filter.request import FAILSAFE, NOT_FINITE, Decision, Request, check_motion
from brakeline.safety.rivals.pretrained import Pretrained


class Rival(ABC):
    """A method with a model that was trained, or whose settings were chosen, beforehand."""

    observed = 0  # the size of the observation that it reads; 0: it reads none

    def __init__(self, model: Pretrained) -> None:
        self.model, self.robot, self.version = model, model.robot, model.version

    def decide(self, request: Request) -> Decision:
        """Return the method's decision; brake if the proposal is not finite. Raises BadRequest: see `check`."""
        started = perf_counter_ns()
        self.check(request)
        if not request.finite:
            return self.braking(request, started, NOT_FINITE)
        return self.correct(request, self.robot.clip_input(request.action, request.input_in_force), started)

    @abstractmethod
    def correct(self, request: Request, proposal: Array, started: int) -> Decision:
        """Return the decision on a clipped proposal (m,). started [ns]: time of the request."""

    def check(self, request: Request) -> None:
        """Check a request.

        Raises:
            BadRequest: a value is missing, not finite, or has the wrong size; `field` names it.
        """
        check_motion(self.robot, request, {"observation": (request.observation, (self.observed,))})

    def braking(self, request: Request, started: int, reason: str) -> Decision:
        """Return the failsafe: the backup policy from now on (`backup_plan.brake`)."""
        before = request.input_in_force
        plan = braking_plan(self.robot, self.robot.clip_input(brake(self.robot, before), before))
        return self.decision(FAILSAFE, plan, 0.0, started, reason=reason)

    def decision(self, kind: str, plan: Array, margin: float, started: int, **more: Any) -> Decision:
        """Return a decision, which nothing verifies.

        Args:
            margin: of the plan [m].
            started: time of the request [ns].
            more: other attributes of the decision. The time for which no solver worked counts as that of verifying.
        """
        nothing, total = np.zeros((0, self.robot.position_dim)), (perf_counter_ns() - started) * 1e-6
        return Decision(
            kind=kind,
            plan=plan,
            tube_center=nothing,
            tube_half_width=nothing,
            predicted=NO_PREDICTION,
            margin=margin if math.isfinite(margin) else 0.0,
            model=self.version,
            verified=False,
            time_ms=total,
            verify_ms=total - more.get("solve_ms", 0.0),
            **more,
        )

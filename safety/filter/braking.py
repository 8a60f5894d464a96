"""The backup policy μ of every robot: brake as fast as the slew allows, for methods that verify nothing.

    μ(u_before) = u_before − clip(u_before, −slew, slew)

Without a slew limit the input is zero at once. An input that the stop rule holds stays as it is.
"""

from __future__ import annotations

import numpy as np

from brakeline.messaging.robot import Array, Robot
from brakeline.safety.filter.backup_plan import NO_PREDICTION
from brakeline.safety.filter.request import FAILSAFE, Decision, Request


def brake(robot: Robot, before: Array) -> Array:
    """Return μ: the input (m,) after the input `before` (m,) while braking."""
    slew = np.asarray(robot.action_slew)
    return np.where(robot.zero_at_rest, before - np.clip(before, -slew, slew), before)


def braking_plan(robot: Robot, first: Array) -> Array:
    """Return the plan (N, m): `first`, then μ. Its last input is zero: the horizon suffices to brake from any input."""
    plan = np.zeros((robot.horizon, robot.action_dim))
    plan[0] = first
    for k in range(1, robot.horizon):
        plan[k] = brake(robot, plan[k - 1])
    return plan


def braking_decision(robot: Robot, request: Request, version: str, reason: str, total: float) -> Decision:
    """Return the failsafe of a method that verifies nothing: μ from now on. total [ms]: time in `decide`."""
    before = request.input_in_force
    return Decision(
        kind=FAILSAFE,
        plan=braking_plan(robot, robot.clip_input(brake(robot, before), before)),
        tube_center=np.zeros((0, robot.position_dim)),
        tube_half_width=np.zeros((0, robot.position_dim)),
        predicted=NO_PREDICTION,
        margin=0.0,
        model=version,
        reason=reason,
        verified=False,
        time_ms=total,
        verify_ms=total,
    )

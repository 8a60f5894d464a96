"""The backup policy μ of every robot: brake as fast as the slew allows, for methods that verify nothing.

    μ(u_before) = u_before − clip(u_before, −slew, slew)

Without a slew limit the input is zero at once. An input that the stop rule holds stays as it is.
"""

from __future__ import annotations

import numpy as np

from brakeline.messaging.robot import Array, Robot


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

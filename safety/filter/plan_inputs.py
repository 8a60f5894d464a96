"""A robot's inputs as regressors of its tubes: within bounds and slew, followed by braking."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from brakeline.messaging.robot import Robot
from brakeline.safety.compilation import compiled

Array = NDArray[np.float64]


@compiled("f8[::1](f8[::1], f8[::1], f8[::1], f8[::1], f8[::1])")
def _limited(wanted: Array, before: Array, low: Array, high: Array, slew: Array) -> Array:
    """The input (m,) closest to the wanted one within bounds and slew; of what is no number, none."""
    found = np.empty(len(wanted))
    for i in range(len(wanted)):
        least, most = max(low[i], before[i] - slew[i]), min(high[i], before[i] + slew[i])
        value = least if wanted[i] < least else wanted[i]
        found[i] = most if value > most else value
    return found


@compiled("f8[::1](f8[::1], f8[:,::1], f8[::1])")
def _followed(z_0: Array, braking: Array, action: Array) -> Array:
    """z_0, and what is left (F, m) of an action (m,) from then on."""
    (F, m), known = braking.shape, len(z_0)
    z = np.empty(known + F * m)
    for j in range(known):
        z[j] = z_0[j]
    for k in range(F):
        for i in range(m):
            z[known + k * m + i] = braking[k, i] * action[i]
    return z


class PlanInputs:
    """z (nz,) is what a tube is linear in: the measured state's part, the input in force, the plan's inputs that are
    given already (together z_0), and the free ones."""

    def __init__(self, robot: Robot) -> None:
        self.robot = robot
        self.low, self.high, self.slew = robot.low(), robot.high(), np.asarray(robot.action_slew, dtype=float)
        self.schedule = robot.plan_matrix()
        self.nothing = robot.zero_input()
        self.braking = np.ascontiguousarray(robot.stop_profile()[: robot.free_steps - robot.committed_steps])

    def limited(self, wanted: Array, before: Array) -> Array:
        """The input (m,) closest to the wanted one within bounds and slew."""
        return _limited(wanted, before, self.low, self.high, self.slew)

    def within(self, free: Array, before: Array) -> Array:
        """Free inputs (F·m,) brought within bounds and slew, one after the other."""
        inputs = free.reshape(-1, self.robot.action_dim).copy()
        for k in range(len(inputs)):
            before = inputs[k] = self.limited(inputs[k], before)
        return inputs.ravel()

    def stop(self, state: Array, before: Array) -> Array:
        """The strongest braking's next input: to zero, held, or what the feedback makes of the state."""
        wanted = np.where(self.robot.zero_at_rest, self.nothing, before)
        return self.limited(self.robot.stop_by_feedback(wanted, state, before), before)

    def regressors(self, z_0: Array, action: Array) -> Array:
        """z of an action followed by braking."""
        return _followed(z_0, self.braking, action)

    def plan(self, z: Array) -> Array:
        """The inputs (N, m) that regressors z speak of."""
        return (self.schedule @ z[self.robot.regressor_dim :]).reshape(self.robot.horizon, -1)

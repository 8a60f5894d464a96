"""Inputs of a plan: clipped to bounds and slew, followed by braking, and as regressors z (docs/method.md §2)."""

from __future__ import annotations

from itertools import product

import numpy as np

from brakeline.compilation import compiled
from brakeline.messaging.robot import Array, Robot
from brakeline.safety.model.model_set import ModelSet
from brakeline.safety.model.turning_in_place import widened

MOST_COMBINED = 3  # inputs


@compiled("f8[::1](f8[::1], f8[::1], f8[::1], f8[::1], f8[::1])")
def clip_to_bounds(wanted: Array, before: Array, low: Array, high: Array, slew: Array) -> Array:
    """Return the input (m,) closest to the wanted one within bounds and slew. NaN stays NaN."""
    clipped = np.empty(len(wanted))
    for i in range(len(wanted)):
        least, most = max(low[i], before[i] - slew[i]), min(high[i], before[i] + slew[i])
        value = least if wanted[i] < least else wanted[i]
        clipped[i] = most if value > most else value
    return clipped


@compiled("f8[::1](f8[::1], f8[:,::1], f8[::1])")
def regressors_of_braking(z_0: Array, braking: Array, action: Array) -> Array:
    """Return z = [z_0; free inputs]: free input k is the share braking[k] (m,) of the action (m,)."""
    (F, m), known = braking.shape, len(z_0)
    z = np.empty(known + F * m)
    for j in range(known):
        z[j] = z_0[j]
    for k in range(F):
        for i in range(m):
            z[known + k * m + i] = braking[k, i] * action[i]
    return z


def recorded_inputs(model: ModelSet) -> Array:
    """Return the least and the largest input in force (2, m) in a model set's data, with room for rounding."""
    return widened(model.domain)[:, len(model.robot.regressor) :]


class PlanInputs:
    """A robot's plans and their regressors z = [z_0; f].

    z_0 holds the measured speeds, the input in force, and, in real time, the inputs that are decided already. f (F·m,)
    holds the free inputs, F of them.

    Attributes:
        low, high, slew (m,): bounds of the inputs, and of their change from one period to the next.
        width (m,): range of each input by the robot's description.
        narrower: the inputs that were recorded leave out some of those that the description allows.
        nothing (m,): zero input.
        schedule (N·m, (F + given)·m): S of docs/method.md §2, from the chosen inputs to all inputs of a plan.
        pattern (n, m): inputs that a search tries where its QPs find nothing, from -1 (the least that bounds and slew
            allow) to 1 (the most).
        braking (F, m): share of its value that an input still has in each free period while the robot brakes.
    """

    def __init__(self, robot: Robot, recorded: Array | None = None) -> None:
        """Prepare the plans of a robot.

        Args:
            robot: its description bounds every input.
            recorded: least and largest recorded inputs (2, m), which bound the inputs further. Zero stays possible.
        """
        self.robot = robot
        self.low, self.high, self.slew = robot.low(), robot.high(), np.asarray(robot.action_slew, dtype=float)
        self.width = self.high - self.low
        self.schedule = robot.plan_matrix()
        self.nothing = robot.zero_input()
        if recorded is not None:
            self.low = np.maximum(self.low, np.minimum(recorded[0], self.nothing))
            self.high = np.minimum(self.high, np.maximum(recorded[1], self.nothing))
        self.narrower = bool((self.low > robot.low()).any() or (self.high < robot.high()).any())
        self.pattern = _pattern(robot.action_dim)
        self.braking = np.ascontiguousarray(robot.stop_profile()[: robot.free_steps - robot.committed_steps])

    def limited(self, wanted: Array, before: Array) -> Array:
        """Return the input (m,) closest to the wanted one within bounds and slew of `before` (m,)."""
        return clip_to_bounds(wanted, before, self.low, self.high, self.slew)

    def allows(self, free: Array) -> bool:
        """Return whether free inputs (F·m,) lie within the bounds."""
        inputs = free.reshape(-1, self.robot.action_dim)
        return not self.narrower or bool(((inputs >= self.low) & (inputs <= self.high)).all())

    def within(self, free: Array, before: Array) -> Array:
        """Clip free inputs (F·m,) to bounds and slew, one after the other."""
        inputs = free.reshape(-1, self.robot.action_dim).copy()
        for k in range(len(inputs)):
            before = inputs[k] = self.limited(inputs[k], before)
        return inputs.ravel()

    def stop(self, state: Array, before: Array) -> Array:
        """Return the next input (m,) of the strongest braking: towards zero, held, or by feedback of the state (n,)."""
        wanted = np.where(self.robot.zero_at_rest, self.nothing, before)
        return self.limited(self.robot.stop_by_feedback(wanted, state, before), before)

    def regressors(self, z_0: Array, action: Array) -> Array:
        """Return z (nz,) of an action (m,) followed by braking."""
        return regressors_of_braking(z_0, self.braking, action)

    def plan(self, z: Array) -> Array:
        """Return all inputs (N, m) of the plan with regressors z."""
        return (self.schedule @ z[self.robot.regressor_dim :]).reshape(self.robot.horizon, -1)


def _pattern(m: int) -> Array:
    """Return combinations (n, m) of -1, 0 and 1: all of them for up to three inputs, else of one input at a time."""
    if m <= MOST_COMBINED:
        return np.array([*product((-1.0, 0.0, 1.0), repeat=m)])
    return np.concatenate([np.zeros((1, m)), np.eye(m), -np.eye(m)])

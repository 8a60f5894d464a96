"""A robot's inputs as regressors of its tubes: within bounds and slew, followed by braking."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from messaging.robots import Robot

Array = NDArray[np.float64]


class Inputs:
    """z (nz,) is what a tube is linear in: the measured state's part, the input in force, the plan's inputs that are
    given already (together z_0), and the free ones."""

    def __init__(self, robot: Robot) -> None:
        self.robot = robot
        self.low, self.high, self.slew = robot.low(), robot.high(), np.asarray(robot.action_slew)
        self.schedule = robot.schedule()
        self.nothing = robot.at_zero()
        self.braking = robot.fractions()[: robot.free_steps - robot.given]

    def limited(self, wanted: Array, before: Array) -> Array:
        """The input (m,) closest to the wanted one within bounds and slew."""
        low, high = np.maximum(self.low, before - self.slew), np.minimum(self.high, before + self.slew)
        return np.asarray(np.minimum(np.maximum(wanted, low), high))

    def within(self, free: Array, before: Array) -> Array:
        """Free inputs (F·m,) brought within bounds and slew, one after the other."""
        inputs = free.reshape(-1, self.robot.action_dim).copy()
        for k in range(len(inputs)):
            before = inputs[k] = self.limited(inputs[k], before)
        return inputs.ravel()

    def stop(self, state: Array, before: Array) -> Array:
        """The strongest braking's next input: to zero, held, or what the feedback makes of the state."""
        wanted = np.where(self.robot.stopping, self.nothing, before)
        return self.limited(self.robot.braked(wanted, state, before), before)

    def regressors(self, z_0: Array, action: Array) -> Array:
        """z of an action followed by braking."""
        return np.concatenate([z_0, (self.braking * action).ravel()])

    def plan(self, z: Array) -> Array:
        """The inputs (N, m) that regressors z speak of."""
        return (self.schedule @ z[self.robot.regressor_dim :]).reshape(self.robot.horizon, -1)

"""Plans that turn a standing robot on the spot: predictors and bounds of their own (docs/method.md §1).

Where a robot goes depends on the product of speed and turning, which no predictor that is linear in both can have. One
bound for all plans covers the missing product, so it grows with the turn rate even where the speed is zero. The plans
of a robot that stands, and is given no input that moves its position, are therefore a group of their own.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from brakeline.messaging.robot import INPUT_TOLERANCE, Robot
from brakeline.safety.model.error_bounds import ErrorBound

Array = NDArray[np.float64]

OUTSIDE_DOMAIN = 0.02  # of the recorded range: how far beyond it a regressor may lie (rounding, not extrapolation)
STANDING = 0.01  # of an input's range: a robot that moves no faster stands, if its measurement is better than that


@dataclass(frozen=True)
class InPlace:
    """The predictors for plans in place.

    steps: as in a model set of mode `direct` from free driving, where all inputs of a plan are regressors. box
    (2, r + m): the least and the largest value of [x_0; input in force] (r,) and of each input of the plan (m,) for
    which they hold.
    """

    steps: tuple[ErrorBound, ...]
    box: Array

    def domain(self, regressors: int, known: int) -> Array:
        """(2, regressors): the bounds of regressors z, of which the first `known` are [x_0; input in force]."""
        return widened(over_plan(self.box, regressors, known))


def over_plan(each: Array, regressors: int, known: int) -> Array:
    """Repeat what is given for each input of a plan: (n, r + m) of [x_0; input in force; each input] becomes
    (n, regressors); known: r.
    """
    count = (regressors - known) // (each.shape[1] - known)
    return np.hstack([each[:, :known], np.tile(each[:, known:], count)])


def widened(domain: Array) -> Array:
    """Bounds (2, r) of recorded regressors, with room for rounding."""
    spread = OUTSIDE_DOMAIN * (domain[1] - domain[0])
    return np.stack([domain[0] - spread, domain[1] + spread])


def inside(z: Array, domain: Array) -> NDArray[np.bool_]:
    """Which regressors z (T, nz) lie within the bounds (2, nz)? (T,)."""
    return np.asarray(((z >= domain[0]) & (z <= domain[1])).all(axis=-1))


def turning(robot: Robot) -> NDArray[np.bool_]:
    """Which of [x_0; input in force; each input of a plan] (r + m,) may differ from zero in place: the inputs that do
    not move the position, and the state coordinates that follow them.
    """
    free = ~np.array(robot.translates)
    followed = {index for index, is_free in zip(robot.follows, free, strict=True) if is_free}
    states = np.array([index in followed for index in robot.regressor], dtype=bool)
    return np.concatenate([states, free, free])


def standing_limits(robot: Robot) -> Array | None:
    """Bounds (2, r + m) of [x_0; input in force; each input of a plan] for a robot that stands.

    They are infinite for what may differ from zero in place (`turning`). A measured speed counts as none if its error,
    or one percent of the input that it follows, can make it.

    Returns:
        None for a robot without such plans: none of its inputs, or all of them, move it, or it stops by feedback.
    """
    if all(robot.translates) or not any(robot.translates) or robot.feedback:
        return None
    width = robot.high() - robot.low()
    slow = np.array(robot.measurement_bound, dtype=float)
    for i, index in enumerate(robot.follows):
        if index >= 0:
            slow[index] = max(slow[index], STANDING * width[i])
    most = np.concatenate([slow[list(robot.regressor)], INPUT_TOLERANCE * width, INPUT_TOLERANCE * width])
    most[turning(robot)] = np.inf
    return np.stack([-most, most])

"""Separate predictors and error bounds for plans that turn a standing robot on the spot (docs/method.md §1).

A robot's motion depends on the product of speed and turn rate, which a linear predictor cannot represent. One error
bound for all plans covers the missing product, so it grows with the turn rate even at zero speed. Plans that start at
standstill and contain no input that moves the position therefore form a separate group.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from brakeline.messaging.robot import INPUT_TOLERANCE, Array, Robot
from brakeline.safety.model.error_bounds import ErrorBound

OUTSIDE_DOMAIN = 0.02  # share of the recorded range by which a regressor may exceed it: rounding, not extrapolation
STANDING = 0.01  # share of an input's range; a robot stands below this speed, or below the measurement error if larger


@dataclass(frozen=True)
class InPlace:
    """The predictors for plans that turn in place, and their domain.

    Attributes:
        steps: as in a model set of mode `direct` from free driving, where all inputs of a plan are regressors.
        box (2, r + m): the least and the largest recorded value of [x_0; input in force] (r,) and of each input of the
            plan (m,). The predictors hold only between them.
    """

    steps: tuple[ErrorBound, ...]
    box: Array

    def domain(self, regressors: int, known: int) -> Array:
        """Return the bounds (2, regressors) of regressors z, whose first `known` are [x_0; input in force]."""
        return widened(over_plan(self.box, regressors, known))


def over_plan(columns: Array, regressors: int, known: int) -> Array:
    """Repeat the columns of one input for every input of a plan.

    Args:
        columns (n, r + m): for [x_0; input in force] (r) and for one input of the plan (m).
        regressors: number of columns of the result.
        known: r.

    Returns:
        Array (n, regressors).
    """
    count = (regressors - known) // (columns.shape[1] - known)
    return np.hstack([columns[:, :known], np.tile(columns[:, known:], count)])


def widened(domain: Array) -> Array:
    """Return recorded bounds (2, r), widened to allow for rounding."""
    spread = OUTSIDE_DOMAIN * (domain[1] - domain[0])
    return np.stack([domain[0] - spread, domain[1] + spread])


def inside(z: Array, domain: Array) -> NDArray[np.bool_]:
    """Return which regressors z (T, nz) lie within the bounds `domain` (2, nz), as a mask (T,)."""
    return np.asarray(((z >= domain[0]) & (z <= domain[1])).all(axis=-1))


def turning(robot: Robot) -> NDArray[np.bool_]:
    """Return which of [x_0; input in force; each input of a plan] may differ from zero in place.

    They are the inputs that do not move the position, and the state coordinates that follow these inputs.

    Returns:
        Mask (r + m,).
    """
    free = ~np.array(robot.translates)
    followed = {index for index, is_free in zip(robot.follows, free, strict=True) if is_free}
    states = np.array([index in followed for index in robot.regressor], dtype=bool)
    return np.concatenate([states, free, free])


def standing_limits(robot: Robot) -> Array | None:
    """Return the bounds of [x_0; input in force; each input of a plan] for a robot that stands.

    Entries that may differ from zero in place (`turning`) are unbounded. A measured speed counts as zero up to its
    measurement error, or up to one percent of the range of the input that it follows if that is larger.

    Returns:
        Bounds (2, r + m). None for a robot that stops by feedback, and for one of whose inputs none or all move the
        position: it has no plans that turn in place.
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

"""Kinds of driving in which a statement about the average may not hold (docs/method.md §14)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from brakeline.messaging.labels import split_label
from brakeline.messaging.robot import Array, Robot
from brakeline.safety.model.error_causes import REGIMES, regimes

START, RESTLESS, JUMPING = "start of an episode", "restless inputs", "jumping inputs"
JUMP = 0.5  # share of the largest change that range and slew allow; a change that differs by more is a jump
HELD = 0.95  # share of its largest value above which an input is at its bound
RESTLESS_SHARE, JUMPING_SHARE = 0.3, 0.5  # of a plan's periods with a jump


def driving_kinds(robot: Robot, z: Array, start: NDArray[np.int64]) -> dict[str, NDArray[np.bool_]]:
    """Return which windows (T,) belong to each kind of driving; a window may belong to several kinds.

    A trained policy often holds an input at its bound. A random one seldom does, and the kind "fast" begins at half of
    the bound. So inputs at their bounds are a kind of their own.

    Args:
        robot: the robot.
        z (T, r + m + N·m): regressors with all inputs.
        start (T, 2): trajectory and first period. Plans that begin in the first `horizon` periods of an episode, while
            the robot has no past window to send, belong to its start.
    """
    inputs = z[:, len(robot.regressor) :].reshape(len(z), -1, robot.action_dim)
    changes = np.diff(inputs, axis=1) / np.minimum(robot.high() - robot.low(), np.asarray(robot.action_slew))
    bends = np.abs(np.diff(changes, axis=1, prepend=0.0))  # a steady ramp changes its input but does not jump
    jumps = (bends.max(2) > JUMP).mean(1)
    kinds = {START: start[:, 1] < robot.horizon, JUMPING: jumps > JUMPING_SHARE}
    kinds |= {RESTLESS: (jumps > RESTLESS_SHARE) & ~kinds[JUMPING]}
    driving = regimes(robot, z)
    kinds |= {name: driving == name for name in REGIMES}
    held = np.abs(inputs).min(1) > HELD * np.maximum(np.abs(robot.low()), np.abs(robot.high()))
    return kinds | {name: held[:, i] for i, name in enumerate(at_bound(robot))}


def at_bound(robot: Robot) -> list[str]:
    """Return the names of the kinds of driving in which an input is at its bound, for each input (m,)."""
    return [f"{split_label(label)[0]} at its bound" for label in robot.action]

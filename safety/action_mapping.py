"""Map an environment's actions to a robot's inputs, and back."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import gymnasium
import numpy as np
from numpy.typing import ArrayLike

from brakeline.errors import Mismatch
from brakeline.messaging.robot import Array, Robot

SAME_BOUND = 1e-6  # of an input's range: rounding error of bounds in single precision


@dataclass(frozen=True)
class ActionMapping:
    """A mapping and its inverse. For a vector environment, both also map k actions at once, (k, m).

    >>> in_cm = ActionMapping(lambda action: action / 100.0, lambda control: 100.0 * control)
    >>> in_cm.action_to_control(np.array([25.0, 0.0])).tolist()
    [0.25, 0.0]

    Attributes:
        action_to_control: from an action of the environment to an input (m,) of the robot.
        control_to_action: from an input (m,) to an action.
    """

    action_to_control: Callable[[Any], ArrayLike]
    control_to_action: Callable[[Array], Any]


IDENTITY = ActionMapping(lambda action: action, lambda control: control)


def normalised(robot: Robot) -> ActionMapping:
    """Return the mapping for actions in [-1, 1]: -1 is each input's lowest value, 1 its highest.

    >>> from brakeline import robot_named
    >>> normalised(robot_named("ground")).action_to_control([1.0, 0.0]).tolist()
    [0.25, 0.0]
    """
    low, width = robot.low(), robot.high() - robot.low()

    def action_to_control(action: ArrayLike) -> Array:
        given = np.asarray(action, float)
        # Infinity is not clipped, because the filter must see it.
        clipped = np.where(np.isfinite(given), np.clip(given, -1.0, 1.0), given)
        return np.asarray(low + 0.5 * width * (clipped + 1.0))

    return ActionMapping(action_to_control, lambda control: np.clip(2.0 * (control - low) / width - 1.0, -1.0, 1.0))


def mapping_for_space(space: gymnasium.Space[Any], robot: Robot, given: ActionMapping | None) -> ActionMapping:
    """Return the given mapping, or the identity if an action space is that of the robot's inputs.

    Raises:
        Mismatch: no mapping is given, and the spaces differ.
    """
    if given is not None:
        return given
    inputs = ", ".join(
        f"{name} from {low:g} to {high:g}"
        for name, low, high in zip(robot.action, robot.action_low, robot.action_high, strict=True)
    )
    argument = "actions=ActionMapping(action_to_control, control_to_action)"
    if not isinstance(space, gymnasium.spaces.Box) or space.shape != (robot.action_dim,):
        raise Mismatch(f"the action space {space} is not that of {robot.name}'s inputs ({inputs}): give {argument}")
    near = SAME_BOUND * (robot.high() - robot.low())
    if (np.abs(space.low - robot.low()) > near).any() or (np.abs(space.high - robot.high()) > near).any():
        if (space.low == -1.0).all() and (space.high == 1.0).all():
            argument = f"actions=normalised(robot) if ±1 stands for the bounds, else {argument}"
        raise Mismatch(
            f"the action space {space} has other bounds than {robot.name}'s inputs ({inputs}): give {argument}"
        )
    return IDENTITY


def action_for(control: Array, mapping: ActionMapping, space: gymnasium.Space[Any]) -> Any:
    """Return the action for an input (m,), or for k inputs (k, m), with the type and shape of the action space.

    The mapping gets a copy of the input: it and the environment may overwrite what they get.
    """
    action = mapping.control_to_action(control.copy())
    if not isinstance(space, gymnasium.spaces.Box):
        return action
    if space.dtype is not None and space.dtype.kind in "iu":  # a cast would make 28 of 28.999999999999996
        action = np.rint(action)
    return np.asarray(action, dtype=space.dtype).reshape(space.shape)

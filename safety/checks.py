"""What every method demands of a request before it looks at it."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from messaging.robots import Robot
from safety.filter import FARTHEST, BadRequest, Request


def check_for_rival(robot: Robot, request: Request) -> None:
    """The fields that the rivals read.

    Raises:
        BadRequest: a value is missing, not finite or of the wrong size, with the field's name.
    """
    _finite(robot, "state", request.state, robot.state_dim)
    _finite(robot, "action", request.action, robot.action_dim)
    _finite(robot, "input_in_force", request.input_in_force, robot.action_dim)
    if np.abs(request.state).max() > FARTHEST:
        raise BadRequest("state", f"a state beyond ±{FARTHEST:g} is not plausible")
    before = request.input_in_force
    if (before < robot.low() - 1e-9).any() or (before > robot.high() + 1e-9).any():
        raise BadRequest("input_in_force", "input_in_force: an input is out of the robot's bounds")
    _finite(robot, "observation", request.observation, robot.observation_dim)


def _finite(robot: Robot, name: str, value: NDArray[np.floating[Any]], size: int) -> None:
    if value.shape != (size,):
        raise BadRequest(name, f"{name} has shape {value.shape}, a {robot.name} robot's has {(size,)}")
    if not np.isfinite(value).all():
        raise BadRequest(name, f"{name} holds NaN or infinity")

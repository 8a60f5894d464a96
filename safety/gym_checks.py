"""Check what a Gymnasium wrapper gets: the robot of the environment, the penalty, and the actions of many robots."""

from __future__ import annotations

import json
from typing import Any

import numpy as np

from brakeline.errors import BadRequest, Mismatch
from brakeline.messaging.robot import Array, Robot

UNSHARED = {"accept_bound"}  # in a description: a limit for the model set, which says nothing about the robot


def check_robot(env: Any, robot: Robot) -> None:
    """Check that an environment that states its robot (`env.unwrapped.robot`) has the filter's robot.

    Raises:
        Mismatch: the two descriptions differ; the message names the fields.
    """
    simulated = getattr(env.unwrapped, "robot", None)
    if not isinstance(simulated, Robot) or simulated.layout() == robot.layout():
        return
    ours, theirs = ({name: json.dumps(value) for name, value in one.description.items()} for one in (robot, simulated))
    fields = sorted(name for name in {*ours, *theirs} - UNSHARED if ours.get(name) != theirs.get(name))
    differ = f"descriptions differ in {', '.join(fields)}" if fields else "descriptions differ in real time (`-late`)"
    raise Mismatch(
        f"the environment has the robot {simulated.name}, the filter was made for {robot.name}: their {differ}. "
        "Give both the same description; `brakeline certify DESCRIPTION --use` makes the model set of a description"
    )


def check_rows(inputs: Array, count: int, robot: Robot) -> Array:
    """Return the inputs of many robots, if their shape is (count, m). Raises BadRequest."""
    if np.shape(inputs) != (count, robot.action_dim):
        raise BadRequest(
            "action",
            f"the actions have shape {np.shape(inputs)}: give ({count}, {robot.action_dim}), for each of the {count} "
            f"environments {', '.join(robot.action)}",
        )
    return inputs

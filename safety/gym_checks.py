"""Check what a Gymnasium wrapper gets: the robot of the environment, the age of its accelerations, and many actions."""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any

import gymnasium
import numpy as np

from brakeline.errors import BadRequest, Mismatch
from brakeline.messaging.robot import Array, Robot

AUTORESETS = "Autoreset", "AutoResetWrapper"  # of Gymnasium 1, and of older versions
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


def check_resets(env: Any) -> None:
    """Check that no wrapper inside resets the environment by itself, since a backup plan begins at each reset.

    Raises:
        Mismatch: one does; the message says where to put it.
    """
    while isinstance(env, gymnasium.Wrapper):
        if (name := type(env).__name__) in AUTORESETS:
            raise Mismatch(
                f"{name} inside the wrapper resets the environment unseen: the filter would take the new start for a "
                f"jump of the robot, and widen its sets. Instead, put {name} around the SafetyWrapper"
            )
        env = env.env


def age_of_acceleration(infos: Mapping[str, Any], given: float | None, otherwise: float, method: Any) -> float:
    """Return the age of the horizontal acceleration in the states of one environment or of many [s].

    Args:
        infos: their infos, which may state it as `acceleration_age`.
        given: what the user states instead.
        otherwise: the age if nothing states one.
        method: the filter. A client or a rival states no age here.

    Raises:
        Mismatch: the environments have different ages, or another one than the filter's data.
    """
    rows = np.asarray(infos.get("_acceleration_age", True))  # of a masked reset: the other rows hold zeros
    stated, rows = np.broadcast_arrays(infos.get("acceleration_age", otherwise) if given is None else given, rows)
    ages = sorted(set(stated[rows].tolist()))
    if len(ages) > 1:
        listed = ", ".join(f"{age:g} s" for age in ages)
        raise Mismatch(f"the environments' states hold horizontal accelerations of different ages ({listed})")
    age = float(ages[0]) if ages else otherwise
    if (recorded := getattr(method, "acceleration_age", None)) not in (None, age):
        raise Mismatch(
            f"the model set was recorded with the horizontal acceleration of {recorded:g} s ago, the environment's "
            f"states have that of {age:g} s ago. If they have the same one, give acceleration_age={recorded:g}; "
            "otherwise, report the same one, or use a model set of data with yours"
        )
    return age


def check_rows(inputs: Array, count: int, robot: Robot) -> None:
    """Check the shape (count, m) of the inputs of many robots. Raises BadRequest."""
    if np.shape(inputs) != (count, robot.action_dim):
        raise BadRequest(
            "action",
            f"the actions have shape {np.shape(inputs)}: give ({count}, {robot.action_dim}), for each of the {count} "
            f"environments {', '.join(robot.action)}",
        )

"""Load a model set for a filter: of today's description of the robot, and with a stated bound that is accepted."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from shlex import quote

from brakeline.errors import BadModel
from brakeline.messaging.robot import Robot, robot_named
from brakeline.safety.model.model_set import ModelSet
from brakeline.safety.model.stated_bound import check_bound


def load_model(
    source: Path | str, robot: Robot | Path | str | None = None, accept_bound: float | None = None
) -> ModelSet:
    """Return the model set in a file, or the one that comes with a shipped robot.

    Args:
        source: the path of a model set, or the name of a shipped robot.
        robot: the robot, or its name or the path of its description. By default, the description in the model set
            counts, and nobody notices if the description's file has changed since then.
        accept_bound: the largest accepted share of plans outside their tubes. Defaults to the limit in the description.

    Raises:
        BadModel: the file holds no model set, or one of another description than `robot`.
        TooLoose: the model set states a larger share than is accepted.
        UnknownRobot: `robot` is no robot.
    """
    model = ModelSet.load(source)
    if robot is not None:
        today = robot if isinstance(robot, Robot) else robot_named(robot)
        if not today.in_lockstep().accepts_layout(model.robot.in_lockstep().layout()):
            named = today.kind if isinstance(robot, Robot) else str(robot)
            raise BadModel(
                f"{source} is of another description of {model.robot.kind} than {named} is now: make the model set "
                f"again by `brakeline certify {quote(named)} --use`"
            )
        model = replace(model, robot=replace(model.robot, accept_bound=today.accept_bound))
    check_bound(model, model.robot, accept_bound)
    return model

"""Read a robot from a description (a TOML file, or JSON in a model set), and write its description.

A description with mistakes is refused with all of them at once: each with its field and the values allowed there.
"""

from __future__ import annotations

import math
from functools import lru_cache
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from brakeline.errors import BadDescription, BadText, UnknownRobot
from brakeline.messaging.description_checks import field_problem, inconsistencies
from brakeline.messaging.description_model import DescriptionModel
from brakeline.messaging.labels import split_label
from brakeline.messaging.robot import DEFAULT_ACCEPT_BOUND, FEEDBACK, Disc, Limit, Robot
from brakeline.messaging.structured_text import TOML_ENCODING, parse_toml


def read_robot(path: Path) -> Robot:
    """Read the robot in a file.

    Raises:
        BadDescription: the file has mistakes.
        UnknownRobot: the file cannot be read.
    """
    try:
        text = path.read_text(TOML_ENCODING)
    except (OSError, UnicodeDecodeError) as error:
        raise UnknownRobot(f"{path}: {error}; a robot is a name or the path of a description (.toml)") from error
    return _parse(text, str(path))


@lru_cache(maxsize=64)
def _parse(text: str, source: str) -> Robot:
    """Return the robot in the text of a file; each text is validated once."""
    try:
        return robot_from_description(parse_toml(text), source)
    except BadText as error:
        raise BadDescription(source, [("", str(error))]) from error


def robot_from_description(values: Any, source: str = "this") -> Robot:
    """Return the robot that a description, as nested dicts, defines.

    >>> cart = {
    ...     "name": "cart", "period": 0.1, "sight": 3.0, "plan": {"horizon": 6, "brake": 1},
    ...     "state": {axis: {"unit": "m", "role": "position", "error": 0.0} for axis in "xy"}
    ...     | {"vx": {"unit": "m/s", "error": 0.0}, "vy": {"unit": "m/s", "error": 0.0}},
    ...     "input": {name: {"unit": "m/s", "low": -1.0, "high": 1.0} for name in ("to vx", "to vy")},
    ...     "body": [{"at": [0.0, 0.0], "radius": 0.2}],
    ... }
    >>> robot_from_description(cart).action
    ('to vx [m/s]', 'to vy [m/s]')

    Args:
        values: the tables of a description's file.
        source: name of the description in error messages.

    Raises:
        BadDescription: the description has mistakes.
    """
    try:
        model = DescriptionModel.model_validate(values)
    except ValidationError as error:
        problems: dict[str, str] = {}
        for detail in error.errors():
            problems.setdefault(*field_problem(detail))
        raise BadDescription(source, list(problems.items())) from error
    if mistakes := list(inconsistencies(model)):
        raise BadDescription(source, mistakes)
    return _robot(model)


def _robot(model: DescriptionModel) -> Robot:
    names, coordinates, inputs = list(model.state), list(model.state.values()), list(model.input.values())
    followers = {c.follows: index for index, c in enumerate(coordinates) if c.follows is not None}
    roles = [c.role for c in coordinates]
    rules = [
        FEEDBACK if isinstance(i.stop, dict) else tuple(i.stop) if isinstance(i.stop, list) else i.stop for i in inputs
    ]
    gains = [_weights(names, i.stop if isinstance(i.stop, dict) else {}) for i in inputs]
    return Robot(
        name=model.name,
        period=model.period,
        state=tuple(f"{name} [{c.unit}]" for name, c in model.state.items()),
        position_dim=roles.count("position"),
        heading=roles.index("heading") if "heading" in roles else None,
        action=tuple(f"{name} [{i.unit}]" for name, i in model.input.items()),
        action_low=tuple(i.low for i in inputs),
        action_high=tuple(i.high for i in inputs),
        translates=tuple(i.moves for i in inputs),
        action_slew=tuple(math.inf if i.slew is None else i.slew for i in inputs),
        regressor=tuple(
            k for k, c in enumerate(coordinates) if (c.role == "other" if c.regressor is None else c.regressor)
        ),
        measurement_bound=tuple(c.error for c in coordinates),
        sight=model.sight or 0.0,
        horizon=model.plan.horizon,
        free_steps=model.plan.free,
        brake_steps=model.plan.brake,
        body=tuple(Disc(tuple(disc.at), disc.radius) for disc in model.body or ()),
        stop=tuple(rules),
        follows=tuple(followers.get(name, -1) for name in model.input),
        feedback=tuple(gains) if FEEDBACK in rules else (),
        stopped=math.inf if model.stopped is None else model.stopped,
        limits=tuple(Limit(limit.name, _weights(names, limit.weights), limit.most) for limit in model.limit),
        accept_bound=model.accept_bound,
    )


def _weights(names: list[str], by_name: dict[str, float]) -> tuple[float, ...]:
    return tuple(float(by_name.get(name, 0.0)) for name in names)


def describe(robot: Robot) -> dict[str, Any]:
    """Return the description of a robot as nested dicts, the inverse of `robot_from_description`."""
    description: dict[str, Any] = {
        "name": robot.name,
        "period": robot.period,
        "sight": robot.sight,
        "state": _describe_state(robot),
        "input": _describe_inputs(robot),
        "plan": {"horizon": robot.horizon, "free": robot.free_steps, "brake": robot.brake_steps},
        "body": [{"at": list(disc.at), "radius": disc.radius} for disc in robot.body],
        "limit": [
            {"name": one.name, "most": one.most, "weights": _nonzero(robot, one.weights)} for one in robot.limits
        ],
    }
    if not robot.position_dim:
        del description["sight"], description["body"]
    if math.isfinite(robot.stopped):
        description["stopped"] = robot.stopped
    if robot.accept_bound != DEFAULT_ACCEPT_BOUND:
        description["accept_bound"] = robot.accept_bound
    return description


def _describe_state(robot: Robot) -> dict[str, Any]:
    input_names = [name for name, _ in map(split_label, robot.action)]
    state: dict[str, Any] = {}
    for k, (name, unit) in enumerate(map(split_label, robot.state)):
        role = "position" if k < robot.position_dim else "heading" if k == robot.heading else "other"
        state[name] = {
            "unit": unit,
            "role": role,
            "error": robot.measurement_bound[k],
            "regressor": k in robot.regressor,
        }
        if k in robot.follows:
            state[name]["follows"] = input_names[robot.follows.index(k)]
    return state


def _describe_inputs(robot: Robot) -> dict[str, Any]:
    inputs: dict[str, Any] = {}
    for i, (name, unit) in enumerate(map(split_label, robot.action)):
        rule: Any = robot.stop[i]
        if rule == FEEDBACK:
            rule = _nonzero(robot, robot.feedback[i])
        inputs[name] = {
            "unit": unit,
            "low": robot.action_low[i],
            "high": robot.action_high[i],
            "moves": robot.translates[i],
            "stop": list(rule) if isinstance(rule, tuple) else rule,
        }
        if math.isfinite(robot.action_slew[i]):
            inputs[name]["slew"] = robot.action_slew[i]
    return inputs


def _nonzero(robot: Robot, weights: tuple[float, ...]) -> dict[str, float]:
    """Return the weights that are not zero, by the names of their state coordinates."""
    names = [name for name, _ in map(split_label, robot.state)]
    return {name: weight for name, weight in zip(names, weights, strict=True) if weight}

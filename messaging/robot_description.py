"""Read a robot from a description (a TOML file, or JSON in a model set), and write its description.

A description with mistakes is refused with all of them at once: each with its field and the values allowed there.
"""

from __future__ import annotations

import difflib
import math
import re
from collections import Counter
from collections.abc import Iterator
from functools import lru_cache
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import AfterValidator, BaseModel, BeforeValidator, ConfigDict, Field, ValidationError

from brakeline.errors import BadDescription, BadText, UnknownRobot
from brakeline.messaging.robot import DEFAULT_ACCEPT_BOUND, FEEDBACK, HOLD, RAMP, Disc, Limit, Robot
from brakeline.messaging.robot_files import REAL_TIME_SUFFIX
from brakeline.messaging.structured_text import parse_toml

NAME = re.compile(r"[A-Za-z0-9_.]+(-[A-Za-z0-9_.]+)*")
MAX_NAME_LENGTH = 64
UNITS = ("m", "rad", "m/s", "rad/s", "m/s2", "rad/s2", "N", "N m", "V", "A", "Pa", "K", "1")
UNIT_OF_ROLE = {"position": "m", "heading": "rad"}
INPUT_ROUNDING = 1e-12
STOP_RULES = "'ramp', 'hold', fractions such as [0.5, 0.2, 0.0], or gains such as { speed = -4.0 }"
Problem = tuple[str, str]  # a field, and its mistake with the allowed values


def _check_number(value: object) -> object:
    if isinstance(value, bool):
        raise ValueError("a number")
    return value


Number = Annotated[float, BeforeValidator(_check_number)]
Whole = Annotated[int, BeforeValidator(_check_number)]
Finite = Annotated[Number, Field(allow_inf_nan=False)]
Positive = Annotated[Number, Field(gt=0.0, allow_inf_nan=False)]


def _check_unit(unit: str) -> str:
    if unit not in UNITS:
        raise ValueError(f"one of {', '.join(UNITS)} (SI)")
    return unit


Unit = Annotated[str, AfterValidator(_check_unit)]


class _Strict(BaseModel):
    model_config = ConfigDict(extra="forbid", strict=False, frozen=True)


class CoordinateModel(_Strict):
    """One coordinate of the state."""

    unit: Unit
    role: Literal["position", "heading", "other"] = "other"
    error: Annotated[Number, Field(ge=0.0, allow_inf_nan=False)]
    follows: str | None = None
    regressor: bool | None = None  # None: true for the role "other"


class InputModel(_Strict):
    """One input."""

    unit: Unit
    low: Finite
    high: Finite
    moves: bool = True
    slew: Positive | None = None  # None: no limit
    stop: Literal["ramp", "hold"] | list[Finite] | dict[str, Finite] = "ramp"


class PlanModel(_Strict):
    """The number of periods of a plan, of its free inputs, and of a ramp to zero."""

    horizon: Annotated[Whole, Field(ge=2, le=64)]
    free: Annotated[Whole, Field(ge=1, le=8)] = 1
    brake: Annotated[Whole, Field(ge=1, le=64)]


class DiscModel(_Strict):
    """One disc of the body."""

    at: list[Finite]
    radius: Positive


class LimitModel(_Strict):
    """A half-space over named coordinates: the sum of weights times coordinates is at most `most`."""

    name: Annotated[str, Field(min_length=1, max_length=MAX_NAME_LENGTH)]
    weights: dict[str, Finite]
    most: Finite


class DescriptionModel(_Strict):
    """A robot description before the checks that concern several fields."""

    name: Annotated[str, Field(max_length=MAX_NAME_LENGTH)]
    period: Annotated[Number, Field(ge=0.002, le=10.0)]
    sight: Positive | None = None  # required with a position, refused without one
    state: Annotated[dict[str, CoordinateModel], Field(min_length=1, max_length=32)]
    input: Annotated[dict[str, InputModel], Field(min_length=1, max_length=16)]
    plan: PlanModel
    body: Annotated[list[DiscModel], Field(min_length=1, max_length=8)] | None = None  # as sight
    limit: Annotated[list[LimitModel], Field(max_length=32)] = []
    stopped: Positive | None = None
    # Below 1: a model set that states no bound counts as 1 and must always be confirmed.
    accept_bound: Annotated[Number, Field(gt=0.0, lt=1.0, allow_inf_nan=False)] = DEFAULT_ACCEPT_BOUND

    def role_names(self, role: str) -> list[str]:
        """Return the names of the coordinates with a role."""
        return [name for name, coordinate in self.state.items() if coordinate.role == role]


SECTIONS: dict[str, type[BaseModel]] = {
    "state": CoordinateModel,
    "input": InputModel,
    "plan": PlanModel,
    "body": DiscModel,
    "limit": LimitModel,
}


def read_robot(path: Path) -> Robot:
    """Read the robot in a file.

    Raises:
        BadDescription: the file has mistakes.
        UnknownRobot: the file cannot be read.
    """
    try:
        text = path.read_text()
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
            problems.setdefault(*_problem(detail))
        raise BadDescription(source, list(problems.items())) from error
    if inconsistencies := list(_inconsistencies(model)):
        raise BadDescription(source, inconsistencies)
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

    def split(labels: tuple[str, ...]) -> list[tuple[str, str]]:
        parts = [label.rpartition(" [") for label in labels]
        return [(name, unit.removesuffix("]")) for name, _, unit in parts]

    def nonzero(weights: tuple[float, ...]) -> dict[str, float]:
        return {name: weight for name, weight in zip(state, weights, strict=True) if weight}

    state: dict[str, Any] = {}
    inputs: dict[str, Any] = {}
    input_labels = split(robot.action)
    for k, (name, unit) in enumerate(split(robot.state)):
        role = "position" if k < robot.position_dim else "heading" if k == robot.heading else "other"
        state[name] = {
            "unit": unit,
            "role": role,
            "error": robot.measurement_bound[k],
            "regressor": k in robot.regressor,
        }
        if k in robot.follows:
            state[name]["follows"] = input_labels[robot.follows.index(k)][0]
    for i, (name, unit) in enumerate(input_labels):
        rule: Any = robot.stop[i]
        inputs[name] = {
            "unit": unit,
            "low": robot.action_low[i],
            "high": robot.action_high[i],
            "moves": robot.translates[i],
            "stop": nonzero(robot.feedback[i]) if rule == FEEDBACK else list(rule) if isinstance(rule, tuple) else rule,
        }
        if math.isfinite(robot.action_slew[i]):
            inputs[name]["slew"] = robot.action_slew[i]
    description: dict[str, Any] = {
        "name": robot.name,
        "period": robot.period,
        "sight": robot.sight,
        "state": state,
        "input": inputs,
        "plan": {"horizon": robot.horizon, "free": robot.free_steps, "brake": robot.brake_steps},
        "body": [{"at": list(disc.at), "radius": disc.radius} for disc in robot.body],
        "limit": [{"name": one.name, "most": one.most, "weights": nonzero(one.weights)} for one in robot.limits],
    }
    if not robot.position_dim:
        del description["sight"], description["body"]
    if math.isfinite(robot.stopped):
        description["stopped"] = robot.stopped
    if robot.accept_bound != DEFAULT_ACCEPT_BOUND:
        description["accept_bound"] = robot.accept_bound
    return description


def _problem(detail: Any) -> Problem:
    """Return the field and the mistake in one of pydantic's errors."""
    path = [str(part) for part in detail["loc"]]
    text = str(detail["msg"]).removeprefix("Value error, ")
    if detail["type"] == "missing":
        text = "missing"
    elif detail["type"] == "extra_forbidden":
        allowed = list((SECTIONS[path[0]] if len(path) > 1 else DescriptionModel).model_fields)
        similar = difflib.get_close_matches(path[-1], allowed, 1)
        hint = f"; did you mean {similar[0]!r}?" if similar else ""
        text = f"unknown{hint} (allowed here: {', '.join(allowed)})"
    elif path[:1] + path[2:3] == ["input", "stop"]:  # pydantic has an error for each type that a rule may have
        path, text = path[:3], f"{STOP_RULES}, not {detail['input']!r:.80}"
    else:
        text = f"{text[:1].lower()}{text[1:]}, not {detail['input']!r:.80}"
    return ".".join(path), text


def _inconsistencies(model: DescriptionModel) -> Iterator[Problem]:
    """Yield the mistakes that concern several fields."""
    if not NAME.fullmatch(model.name) or model.name.endswith(REAL_TIME_SUFFIX) or not model.name.strip("."):
        allowed = f"letters, digits, '_', '.' and '-', not only dots, and not ending in {REAL_TIME_SUFFIX!r}"
        yield "name", f"{allowed}; not {model.name!r}"
    yield from _state_problems(model)
    for name, one in model.input.items():
        for field, text in _input_problems(model, one):
            yield f"input.{name}.{field}", text
    least = model.plan.free + model.plan.brake
    if model.plan.horizon < least:
        yield (
            "plan.horizon",
            f"{model.plan.horizon} periods do not fit {model.plan.free} free inputs and {model.plan.brake} periods "
            f"of braking: at least {least}",
        )
    d = len(model.role_names("position"))
    yield from _space_problems(model, d)
    for i, disc in enumerate(model.body or ()):
        if len(disc.at) != d:
            yield f"body.{i}.at", f"{len(disc.at)} coordinates, the position has {d}"
        if any(disc.at) and not model.role_names("heading"):
            yield f"body.{i}.at", "all zeros: without a heading, the discs of the body are about the position"
    for i, limit in enumerate(model.limit):
        unknown = [name for name in limit.weights if name not in model.state]
        if unknown or not any(limit.weights.values()):
            names = ", ".join(model.state)
            yield f"limit.{i}.weights", f"names of state coordinates ({names}), not {', '.join(unknown)}"
        if limit.name in [other.name for other in model.limit[:i]]:
            yield f"limit.{i}.name", f"another limit is called {limit.name!r}"


def _space_problems(model: DescriptionModel, d: int) -> Iterator[Problem]:
    """Check what a description says about space: a robot with a position sees obstacles, another one has limits."""
    for field in ("sight", "body"):
        given = getattr(model, field) is not None
        if d and not given:
            yield field, "missing"
        if given and not d:
            yield field, f"a robot without a position has no {field}: leave it out, or give coordinates that role"
    if d:
        return
    if not model.limit:
        yield "limit", "a robot without a position needs a limit: there is nothing else that a plan must respect"
    for name, c in model.state.items():
        if c.regressor is False:
            yield f"state.{name}.regressor", "without a position, every coordinate is a regressor"
    for name, one in model.input.items():
        if isinstance(one.stop, dict):
            yield f"input.{name}.stop", "a robot without a position stops by 'ramp', 'hold' or a profile, not by gains"


def _state_problems(model: DescriptionModel) -> Iterator[Problem]:
    roles = [c.role for c in model.state.values()]
    d = roles.count("position")
    if d not in (0, 2, 3) or roles[:d] != ["position"] * d:
        yield "state", "two or three coordinates with role 'position' come first; in joint space there is none"
    if "heading" in roles and not d:
        yield "state", "a heading belongs to a robot with a position: give the joint no role"
    if roles.count("heading") > 1 or ("heading" in roles and roles.index("heading") != d):
        yield "state", "one coordinate with role 'heading' at most, right after the position"
    if "heading" in roles and d == 3:
        yield "state", "a heading belongs to a robot in the plane"
    if "other" not in roles:
        yield "state", "besides the pose, a speed or another coordinate that determines the next step is needed"
    for name, c in model.state.items():
        if c.unit != UNIT_OF_ROLE.get(c.role, c.unit):
            yield f"state.{name}.unit", f"a {c.role} is in {UNIT_OF_ROLE[c.role]}, not {c.unit!r}"
        if c.role != "other" and c.regressor:
            yield f"state.{name}.regressor", "the model predicts the displacement: a pose is no regressor"
        if c.follows is None:
            continue
        if c.follows not in model.input:
            yield f"state.{name}.follows", f"one of the inputs ({', '.join(model.input)}), not {c.follows!r}"
        elif (unit := model.input[c.follows].unit) != c.unit:
            yield f"state.{name}.follows", f"in {c.unit!r} it can't follow {c.follows!r}, which is in {unit!r}"
    followers = Counter(c.follows for c in model.state.values() if c.follows is not None)
    for name, count in followers.items():
        if count > 1:
            yield "state", f"two coordinates follow {name!r}"


def _input_problems(model: DescriptionModel, one: InputModel) -> Iterator[Problem]:
    """Check the bounds, the slew and the stop rule of an input against each other and against the plan."""
    if not one.low < one.high:
        yield "high", f"above low ({one.low:g}), not {one.high:g}"
    rule = one.stop
    if rule != HOLD and not one.low <= 0.0 <= one.high:
        yield "low", f"a stop is zero input, which must lie within the bounds {one.low:g} to {one.high:g}"
    if rule == RAMP and one.slew is not None:
        steepest = max(abs(one.low), abs(one.high)) / model.plan.brake
        if steepest > one.slew + INPUT_ROUNDING:
            yield "slew", f"{one.slew:g} a period can't follow the ramp, which falls by {steepest:g} (plan.brake)"
    if isinstance(rule, list):
        for text in _profile_problems(model.plan, one, rule):
            yield "stop", text
    if isinstance(rule, dict):
        allowed = model.role_names("other")
        unknown = [name for name in rule if name not in allowed]
        if unknown or not rule:
            yield (
                "stop",
                f"gains on speeds ({', '.join(allowed)}), not on {', '.join(unknown) or 'nothing'}",
            )
        if model.plan.free != 1:
            yield "stop", "a stop by feedback needs one free input: plan.free = 1"
        if model.stopped is None:
            yield "stop", "a stop by feedback needs `stopped`: the residual speed that counts as standing"


def _profile_problems(plan: PlanModel, one: InputModel, profile: list[float]) -> Iterator[str]:
    if not profile or profile[-1] != 0.0:
        yield "a profile of fractions of the last free input ends in 0"
    if len(profile) > plan.horizon - plan.free:
        yield f"{len(profile)} fractions, but the plan has {plan.horizon - plan.free} periods for them"
    inputs = np.outer((one.low, one.high), [1.0, *profile])
    if (inputs < one.low - INPUT_ROUNDING).any() or (inputs > one.high + INPUT_ROUNDING).any():
        yield "the profile of an input at its bound leaves the bounds"
    if one.slew is not None and (np.abs(np.diff(inputs)) > one.slew + INPUT_ROUNDING).any():
        yield f"slew {one.slew:g} can't follow the profile"

"""A robot's description as a file (TOML) or as JSON in a model set, checked field by field, and the `Robot` in it.

Every mistake is told at once, each with its field and what is allowed there.
"""

from __future__ import annotations

import difflib
import math
import re
import tomllib
from collections import Counter
from functools import lru_cache
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import AfterValidator, BaseModel, ConfigDict, Field, ValidationError

from brakeline.messaging.robot import (
    DEFAULT_ACCEPT_BOUND,
    FEEDBACK,
    HOLD,
    RAMP,
    REAL_TIME_SUFFIX,
    Disc,
    Limit,
    Robot,
    UnknownRobot,
)

NAME = re.compile(r"[A-Za-z0-9_.]+(-[A-Za-z0-9_.]+)*")
LONGEST = 64  # characters of a name
UNITS = ("m", "rad", "m/s", "rad/s", "m/s2", "rad/s2", "N", "N m", "V", "A", "1")
UNIT_OF = {"position": "m", "heading": "rad"}
Finite = Annotated[float, Field(allow_inf_nan=False)]
Positive = Annotated[float, Field(gt=0.0, allow_inf_nan=False)]


def _si(unit: str) -> str:
    if unit not in UNITS:
        raise ValueError(f"one of {', '.join(UNITS)} (SI)")
    return unit


Unit = Annotated[str, AfterValidator(_si)]


class BadDescription(UnknownRobot):
    """A description that is none: `problems` has a (field, what is wrong and what is allowed) for every mistake."""

    def __init__(self, source: str, problems: list[tuple[str, str]]) -> None:
        lines = "".join(f"\n  {field}: {text}" for field, text in problems)
        super().__init__(f"{source} is no robot's description:{lines}")
        self.problems = problems


class _Strict(BaseModel):
    model_config = ConfigDict(extra="forbid", strict=False, frozen=True)


class Coordinate(_Strict):
    """One of the state."""

    unit: Unit
    role: Literal["position", "heading", "other"] = "other"
    error: Annotated[float, Field(ge=0.0, allow_inf_nan=False)]
    follows: str | None = None
    regressor: bool | None = None  # None: all but position and heading


class Input(_Strict):
    unit: Unit
    low: Finite
    high: Finite
    moves: bool = True
    slew: Positive | None = None  # None: none
    stop: Literal["ramp", "hold"] | list[Finite] | dict[str, Finite] = "ramp"


class Plan(_Strict):
    horizon: Annotated[int, Field(ge=2, le=64)]
    free: Annotated[int, Field(ge=1, le=8)] = 1
    brake: Annotated[int, Field(ge=1, le=64)]


class Body(_Strict):
    at: list[Finite]
    radius: Positive


class Bound(_Strict):
    """A half-space over named coordinates: the sum of weights times coordinates is at most that."""

    name: Annotated[str, Field(min_length=1, max_length=LONGEST)]
    weights: dict[str, Finite]
    most: Finite


class Description(_Strict):
    name: Annotated[str, Field(max_length=LONGEST)]
    period: Annotated[float, Field(ge=0.002, le=10.0)]
    sight: Positive
    state: Annotated[dict[str, Coordinate], Field(min_length=1, max_length=32)]
    input: Annotated[dict[str, Input], Field(min_length=1, max_length=16)]
    plan: Plan
    body: Annotated[list[Body], Field(min_length=1, max_length=8)]
    limit: Annotated[list[Bound], Field(max_length=32)] = []
    stopped: Positive | None = None
    # The largest share of plans outside their tubes, as a model set states it, that is used without a question. It is
    # below 1, which is what a model set without a statement counts as.
    accept_bound: Annotated[float, Field(gt=0.0, lt=1.0, allow_inf_nan=False)] = DEFAULT_ACCEPT_BOUND


def read(path: Path) -> Robot:
    """The robot in a file.

    Raises:
        BadDescription: with every mistake; UnknownRobot: there is no such file, or it is no TOML.
    """
    try:
        text = path.read_text()
    except (OSError, UnicodeDecodeError) as error:
        raise UnknownRobot(f"{path}: {error}; a robot is a name or the path of a description (.toml)") from error
    return _robot_in(text, str(path))


@lru_cache(maxsize=64)
def _robot_in(text: str, source: str) -> Robot:
    """The robot in a file of this content: the file is read each time, and checked once."""
    try:
        return robot_from_description(tomllib.loads(text), source)
    except tomllib.TOMLDecodeError as error:
        raise BadDescription(source, [("", f"not TOML: {error}")]) from error


def robot_from_description(values: Any, source: str = "this") -> Robot:
    """The robot that a description, as nested dicts, says.

    Raises:
        BadDescription: with every mistake.
    """
    try:
        said = Description.model_validate(values)
    except ValidationError as error:
        raise BadDescription(source, [_problem(detail, values) for detail in error.errors()]) from error
    if problems := list(_inconsistent(said)):
        raise BadDescription(source, problems)
    return _robot(said)


def _robot(said: Description) -> Robot:
    names, inputs = list(said.state), list(said.input.values())
    roles = [c.role for c in said.state.values()]
    d = roles.count("position")
    gains = [_weights(names, one.stop) if isinstance(one.stop, dict) else (0.0,) * len(names) for one in inputs]
    following = {c.follows: i for i, c in enumerate(said.state.values()) if c.follows is not None}
    rules = [_rule(one.stop) for one in inputs]
    return Robot(
        name=said.name,
        period=said.period,
        state=tuple(f"{name} [{c.unit}]" for name, c in said.state.items()),
        position_dim=d,
        heading=roles.index("heading") if "heading" in roles else None,
        action=tuple(f"{name} [{i.unit}]" for name, i in said.input.items()),
        action_low=tuple(i.low for i in inputs),
        action_high=tuple(i.high for i in inputs),
        translates=tuple(i.moves for i in inputs),
        action_slew=tuple(math.inf if i.slew is None else i.slew for i in inputs),
        regressor=tuple(
            k for k, c in enumerate(said.state.values()) if (c.role == "other" if c.regressor is None else c.regressor)
        ),
        measurement_bound=tuple(c.error for c in said.state.values()),
        sight=said.sight,
        horizon=said.plan.horizon,
        free_steps=said.plan.free,
        brake_steps=said.plan.brake,
        body=tuple(Disc(tuple(disc.at), disc.radius) for disc in said.body),
        stop=tuple(rules),
        follows=tuple(following.get(name, -1) for name in said.input),
        feedback=tuple(gains) if FEEDBACK in rules else (),
        stopped=math.inf if said.stopped is None else said.stopped,
        limits=tuple(Limit(bound.name, _weights(names, bound.weights), bound.most) for bound in said.limit),
        accept_bound=said.accept_bound,
    )


def _rule(said: str | list[float] | dict[str, float]) -> str | tuple[float, ...]:
    if isinstance(said, dict):
        return FEEDBACK
    return tuple(said) if isinstance(said, list) else said


def describe(robot: Robot) -> dict[str, Any]:
    """The description of a robot: `robot_from_description` makes the same robot of it."""

    def plain(label: str) -> tuple[str, str]:
        name, _, unit = label.rpartition(" [")
        return name, unit.removesuffix("]")

    names = [plain(label)[0] for label in robot.state]
    inputs = [plain(label)[0] for label in robot.action]
    state: dict[str, Any] = {}
    for k, label in enumerate(robot.state):
        role = "position" if k < robot.position_dim else "heading" if k == robot.heading else "other"
        state[names[k]] = {"unit": plain(label)[1], "role": role, "error": robot.measurement_bound[k]}
        state[names[k]]["regressor"] = k in robot.regressor
        if k in robot.follows:
            state[names[k]]["follows"] = inputs[robot.follows.index(k)]
    given: dict[str, Any] = {}
    for i, label in enumerate(robot.action):
        rule: Any = robot.stop[i]
        if rule == FEEDBACK:
            rule = {name: gain for name, gain in zip(names, robot.feedback[i], strict=True) if gain}
        given[inputs[i]] = {
            "unit": plain(label)[1],
            "low": robot.action_low[i],
            "high": robot.action_high[i],
            "moves": robot.translates[i],
            "stop": list(rule) if isinstance(rule, tuple) else rule,
        }
        if math.isfinite(robot.action_slew[i]):
            given[inputs[i]]["slew"] = robot.action_slew[i]
    limits = [
        {"name": one.name, "most": one.most, "weights": {n: w for n, w in zip(names, one.weights, strict=True) if w}}
        for one in robot.limits
    ]
    said = {
        "name": robot.name,
        "period": robot.period,
        "sight": robot.sight,
        "state": state,
        "input": given,
        "plan": {"horizon": robot.horizon, "free": robot.free_steps, "brake": robot.brake_steps},
        "body": [{"at": list(disc.at), "radius": disc.radius} for disc in robot.body],
        "limit": limits,
    }
    said |= {"stopped": robot.stopped} if math.isfinite(robot.stopped) else {}
    return said | ({"accept_bound": robot.accept_bound} if robot.accept_bound != DEFAULT_ACCEPT_BOUND else {})


def _weights(names: list[str], by_name: dict[str, float]) -> tuple[float, ...]:
    return tuple(float(by_name.get(name, 0.0)) for name in names)


def _problem(detail: Any, values: Any) -> tuple[str, str]:
    """A field and what is wrong there, from one of pydantic's errors."""
    place = [str(part) for part in detail["loc"]]
    field, text = ".".join(place), str(detail["msg"])
    if detail["type"] == "extra_forbidden":
        allowed = _allowed([str(part) for part in detail["loc"][:-1]])
        near = difflib.get_close_matches(place[-1], allowed, 1)
        meant = f"; did you mean {near[0]!r}?" if near else ""
        text = f"unknown{meant} (allowed here: {', '.join(allowed)})"
    elif detail["type"] == "missing":
        text = "missing"
    else:
        text = text.removeprefix("Value error, ")
        text = f"{text[:1].lower()}{text[1:]}, not {detail['input']!r:.80}"
    return field, text


def _allowed(place: list[str]) -> list[str]:
    """The fields that there are at a place in the description."""
    kinds: dict[str, type[BaseModel]] = {
        "state": Coordinate,
        "input": Input,
        "plan": Plan,
        "body": Body,
        "limit": Bound,
    }
    return list((kinds[place[0]] if place else Description).model_fields)


def _inconsistent(said: Description) -> list[tuple[str, str]]:
    """What no field alone can tell."""
    found: list[tuple[str, str]] = []
    if not NAME.fullmatch(said.name) or said.name.endswith(REAL_TIME_SUFFIX):
        found.append(
            ("name", f"letters, digits, '_', '.' and '-', not ending in {REAL_TIME_SUFFIX!r}; not {said.name!r}")
        )
    found += _bad_state(said)
    for name, one in said.input.items():
        found += [(f"input.{name}.{field}", text) for field, text in _bad_input(said, name, one)]
    if said.plan.horizon < said.plan.free + said.plan.brake:
        found.append(
            (
                "plan.horizon",
                f"{said.plan.horizon} periods, but {said.plan.free} chosen inputs and {said.plan.brake} periods of "
                f"braking do not fit into them: at least {said.plan.free + said.plan.brake}",
            )
        )
    d = sum(c.role == "position" for c in said.state.values())
    for i, disc in enumerate(said.body):
        if len(disc.at) != d:
            found.append((f"body.{i}.at", f"{len(disc.at)} coordinates, the position has {d}"))
        if any(disc.at) and not any(c.role == "heading" for c in said.state.values()):
            found.append((f"body.{i}.at", "a robot without a heading is held by discs about its position: all zeros"))
    for i, bound in enumerate(said.limit):
        unknown = [name for name in bound.weights if name not in said.state]
        if unknown or not any(bound.weights.values()):
            names = ", ".join(said.state)
            found.append((f"limit.{i}.weights", f"names of state coordinates ({names}), not {', '.join(unknown)}"))
    return found


def _bad_state(said: Description) -> list[tuple[str, str]]:
    found = []
    roles = [c.role for c in said.state.values()]
    d = roles.count("position")
    if d not in (2, 3) or roles[:d] != ["position"] * d:
        found.append(("state", "two or three coordinates with role 'position' come first"))
    if roles.count("heading") > 1 or ("heading" in roles and roles.index("heading") != d):
        found.append(("state", "one coordinate with role 'heading' at most, right after the position"))
    if "heading" in roles and d == 3:
        found.append(("state", "a heading belongs to a robot in the plane"))
    if "other" not in roles:
        found.append(("state", "a speed or whatever else matters for the next step is needed besides the pose"))
    for name, c in said.state.items():
        where = f"state.{name}"
        if c.unit != UNIT_OF.get(c.role, c.unit):
            found.append((f"{where}.unit", f"a {c.role} is in {UNIT_OF[c.role]}, not {c.unit!r}"))
        if c.role != "other" and c.regressor:
            found.append((f"{where}.regressor", "displacement is what is regressed: a pose is no regressor"))
        if c.follows is not None and c.follows not in said.input:
            found.append((f"{where}.follows", f"one of the inputs ({', '.join(said.input)}), not {c.follows!r}"))
        elif c.follows is not None and said.input[c.follows].unit != c.unit:
            unit = said.input[c.follows].unit
            found.append((f"{where}.follows", f"in {c.unit!r} it can't come to {c.follows!r}, which is in {unit!r}"))
    followers = Counter(c.follows for c in said.state.values() if c.follows is not None)
    return found + [("state", f"two coordinates follow {name!r}") for name, count in followers.items() if count > 1]


def _bad_input(said: Description, name: str, one: Input) -> list[tuple[str, str]]:
    """Bounds, slew and stop rule of one input, against each other and the plan."""
    found = []
    if not one.low < one.high:
        found.append(("high", f"above low ({one.low:g}), not {one.high:g}"))
    rule = one.stop
    if rule != HOLD and not one.low <= 0.0 <= one.high:
        found.append(("low", f"a stop is zero input, which must lie within the bounds {one.low:g} to {one.high:g}"))
    if rule == RAMP and one.slew is not None:
        steepest = max(abs(one.low), abs(one.high)) / said.plan.brake
        if steepest > one.slew + 1e-12:
            text = f"{one.slew:g} a period can't follow the ramp, which falls by {steepest:g} (plan.brake)"
            found.append(("slew", text))
    if isinstance(rule, list):
        found += [("stop", text) for text in _bad_profile(said.plan, one, rule)]
    if isinstance(rule, dict):
        unknown = [n for n in rule if n not in said.state or said.state[n].role != "other"]
        if unknown or not rule:
            can = ", ".join(n for n, c in said.state.items() if c.role == "other")
            found.append(("stop", f"gains on speeds and the like ({can}), not on {', '.join(unknown) or 'nothing'}"))
        if said.plan.free != 1:
            found.append(("stop", "a stop by feedback goes with one chosen input: plan.free = 1"))
        if said.stopped is None:
            found.append(("stop", "a stop by feedback needs `stopped`: the residual speed that counts as none"))
    return found


def _bad_profile(plan: Plan, one: Input, profile: list[float]) -> list[str]:
    found = []
    if not profile or profile[-1] != 0.0:
        found.append("a profile of fractions of the last chosen input ends in 0")
    if len(profile) > plan.horizon - plan.free:
        found.append(f"{len(profile)} fractions, but the plan has {plan.horizon - plan.free} periods for them")
    ends = np.outer((one.low, one.high), [1.0, *profile])
    if (ends < one.low - 1e-12).any() or (ends > one.high + 1e-12).any():
        found.append("the profile of an input at its bound leaves the bounds")
    if one.slew is not None and (np.abs(np.diff(ends)) > one.slew + 1e-12).any():
        found.append(f"slew {one.slew:g} can't follow the profile")
    return found

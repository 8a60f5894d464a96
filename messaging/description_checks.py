"""The mistakes in a robot description: of single fields, and of fields that contradict each other."""

from __future__ import annotations

import difflib
import math
from collections import Counter
from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np

from brakeline.messaging.description_model import (
    NAME,
    SECTIONS,
    UNIT_OF_ROLE,
    DescriptionModel,
    InputModel,
    PlanModel,
)
from brakeline.messaging.robot import HOLD, RAMP
from brakeline.messaging.robot_files import REAL_TIME_SUFFIX

INPUT_ROUNDING = 1e-12
STOP_RULES = "'ramp', 'hold', fractions such as [0.5, 0.2, 0.0], or gains such as { speed = -4.0 }"
Problem = tuple[str, str]  # a field, and its mistake with the allowed values


def field_problem(detail: Any) -> Problem:
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


def inconsistencies(model: DescriptionModel) -> Iterator[Problem]:
    """Yield the mistakes that concern several fields, or the name."""
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
    yield from _heading_limit_problems(model)


def _heading_limit_problems(model: DescriptionModel) -> Iterator[Problem]:
    """Check that limits of the heading bound an arc: a measured heading does not tell one turn from the next."""
    for heading in model.role_names("heading"):
        most = {_nonzero(one.weights): one.most for one in model.limit}
        for i, limit in enumerate(model.limit):
            if not (weight := abs(limit.weights.get(heading, 0.0))):
                continue
            other = most.get(_nonzero({name: -value for name, value in limit.weights.items()}))
            if other is None:
                yield (
                    f"limit.{i}.weights",
                    f"{heading} comes back to the same value after a turn: also give the limit of the other side, with "
                    "all weights negated",
                )
            elif not limit.most + other < math.tau * weight:
                yield (
                    f"limit.{i}.most",
                    f"{heading} comes back to the same value after a turn: the limits of both sides must be less than "
                    "2 pi apart. To count turns, add a coordinate without a role",
                )


def _nonzero(weights: Mapping[str, float]) -> frozenset[tuple[str, float]]:
    return frozenset((name, value) for name, value in weights.items() if value)


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
        yield (
            "state",
            "besides the pose, a speed or another coordinate that determines the next step is needed; if the inputs "
            "are the speeds, log those of the period before",
        )
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
            yield (
                f"state.{name}.follows",
                f"in {c.unit!r} it can't follow {c.follows!r}, which is in {unit!r}: leave it out",
            )
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

"""The sections of a robot description with their fields and ranges, as pydantic models."""

from __future__ import annotations

import re
from typing import Annotated, Literal

from pydantic import AfterValidator, BaseModel, BeforeValidator, ConfigDict, Field

from brakeline.messaging.robot import DEFAULT_ACCEPT_BOUND

NAME = re.compile(r"[A-Za-z0-9_.]+(-[A-Za-z0-9_.]+)*")
MAX_NAME_LENGTH = 64
UNITS = ("m", "rad", "m/s", "rad/s", "m/s2", "rad/s2", "N", "N m", "V", "A", "Pa", "K", "1")
UNIT_OF_ROLE = {"position": "m", "heading": "rad"}


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
        return [name for name, coordinate in self.state.items() if coordinate.role == role]


SECTIONS: dict[str, type[BaseModel]] = {
    "state": CoordinateModel,
    "input": InputModel,
    "plan": PlanModel,
    "body": DiscModel,
    "limit": LimitModel,
}

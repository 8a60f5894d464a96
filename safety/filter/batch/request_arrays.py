"""Requests of many robots of one kind as arrays, with the batch first."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import array_api_compat
import numpy as np

from brakeline.errors import BadRequest
from brakeline.safety.filter.backup_plan import Prediction
from brakeline.safety.filter.batch.obstacle_arrays import Array, ObstacleArrays, TurnBatch, mapped, on_host
from brakeline.safety.filter.request import FastRequestCheck, Request
from brakeline.safety.filter.widening import PastWindow


@dataclass(frozen=True)
class PredictionArrays:
    """The predicted sets of the measured states: `Prediction` for each robot that has one.

    >>> PredictionArrays(np.zeros((2, 5)), np.full((2, 5), 0.1), np.zeros(2), given=np.array([True, False])).given.sum()
    np.int64(1)

    Attributes:
        center (B, n): see `Prediction`.
        half_width (B, n): see `Prediction`.
        heading (B,): see `Prediction`.
        given (B,): whether the robot has one; the other rows are ignored.
    """

    center: Array
    half_width: Array
    heading: Array
    given: Array

    def errors(self, xp: Any, states: Array, heading: int | None) -> Array:
        """Return the distances (B, n) of measured states from the centers, in the predicted frames.

        heading: its index in a state, as `Robot.heading`.
        """
        off = [states[:, i] - self.center[:, i] for i in range(states.shape[1])]
        if heading is not None:
            off = TurnBatch(xp.cos(self.heading), xp.sin(self.heading)).to_robot(off)
            off[heading] = xp.remainder(off[heading] + math.pi, math.tau) - math.pi
        return xp.abs(xp.stack(off, axis=1))


@dataclass(frozen=True)
class PastArrays:
    """The last periods of each robot: `PastWindow` for each robot that has one.

    >>> both = np.ones(2, dtype=bool)
    >>> PastArrays(np.zeros((2, 3, 5)), np.zeros((2, 4, 2)), from_start=~both, given=both).inputs.shape
    (2, 4, 2)

    Attributes:
        states (B, N, n): see `PastWindow`.
        inputs (B, N + 1, m): see `PastWindow`.
        from_start (B,): see `PastWindow`.
        given (B,): whether the robot has one; the other rows are ignored.
    """

    states: Array
    inputs: Array
    from_start: Array
    given: Array


@dataclass(frozen=True)
class RequestArrays:
    """Requests of B robots of one kind, as `Request` has them; every array is of one namespace and on one device.

    A batch describes surroundings by obstacles that stand still. A request with a scan, moving obstacles or
    reservations has no place in it: `Filter.decide_all` decides such requests singly.

    >>> from brakeline import Request, Shapes
    >>> stand = np.zeros((3, 2))
    >>> request = Request(np.zeros(5), [0.2, 0.0], stand[0], stand, Shapes.of([], dim=2), known_free=True)
    >>> requests = RequestArrays.of([request] * 3)
    >>> len(requests), requests.plan.shape, requests.row(2).action.tolist()
    (3, (3, 3, 2), [0.2, 0.0])

    Attributes:
        state (B, n): float64, as the other arrays of numbers.
        action (B, m): proposals.
        input_in_force (B, m): inputs of the period before.
        plan (B, N, m): rests of the backup plans.
        obstacles: at least those within the robot's `sight` of the measured positions.
        known_free (B,): all space within reach is free, apart from the obstacles; bool.
        turn_aside: the filter turns blocked robots aside (`Request.turn_aside`), for each robot (B,), or for all.
        widening (B,): factor on every set of a plan, at least 1. None: 1 for all.
        state_widening (B,): see `Request`. None: 1 for all.
        model: version of the model set that verified the plan, for each robot or for all of them.
        predicted: None if no robot has one.
        past: None if no robot has one.
        observation (B, o): input of a rival's networks, float32; the filter does not need it.
        acceleration_age: see `Request`; the same for all robots.
    """

    state: Array
    action: Array
    input_in_force: Array
    plan: Array
    obstacles: ObstacleArrays
    known_free: Array
    turn_aside: Array | bool = False
    widening: Array | None = None
    state_widening: Array | None = None
    model: Sequence[str] | str = ""
    predicted: PredictionArrays | None = None
    past: PastArrays | None = None
    observation: Array | None = None
    acceleration_age: float = 0.0

    def __len__(self) -> int:
        return int(self.state.shape[0])

    @staticmethod
    def fits(request: Request, check: FastRequestCheck) -> bool:
        """Return whether a request has a place in a batch. `check`: the robot's own check of all numbers."""
        return not _without_place(request) and not request.acceleration_age and check(request)

    @staticmethod
    def of(requests: Sequence[Request]) -> RequestArrays:
        """Pack requests about one kind of robot as NumPy arrays, without their observations.

        Raises:
            BadRequest: an array has not the shape that the others have. Or a request holds what has no place in a
                batch, or the accelerations have different ages.
            ValueError: there is no request.
        """
        if not requests:
            raise ValueError("a batch needs at least one request")
        for row, request in enumerate(requests):
            if lost := _without_place(request):
                why = f"row {row}: a batch has no place for {', '.join(lost)}: give the requests to `Filter.decide_all`"
                raise BadRequest(lost[0], why)
        if len(ages := {request.acceleration_age for request in requests}) > 1:
            raise BadRequest("acceleration_age", f"a batch has accelerations of one age, not {sorted(ages)}")
        given = np.array([request.predicted is not None for request in requests])
        center, half_width, heading = _packed(requests, "predicted", ("center", "half_width", "heading"))
        windows = np.array([request.past is not None for request in requests])
        states, inputs, from_start = _packed(requests, "past", ("states", "inputs", "from_start"))
        state, action, input_in_force, plan = (_stacked(name, requests) for name in _ARRAYS)
        return RequestArrays(
            state,
            action,
            input_in_force,
            plan,
            obstacles=ObstacleArrays.of([request.obstacles for request in requests]),
            known_free=np.array([request.known_free for request in requests], dtype=bool),
            turn_aside=np.array([request.turn_aside for request in requests], dtype=bool),
            widening=np.array([request.widening for request in requests], dtype=float),
            state_widening=np.array([request.state_widening for request in requests], dtype=float),
            model=[request.model for request in requests],
            predicted=PredictionArrays(center, half_width, heading, given) if given.any() else None,
            past=PastArrays(states, inputs, from_start > 0.0, windows) if windows.any() else None,
            acceleration_age=ages.pop(),
        )

    def mapped(self, change: Callable[[Array], Array]) -> RequestArrays:
        """Return the requests with every array changed, for example moved to a GPU.

        >>> from brakeline import Request, RequestArrays, Shapes
        >>> stand = np.zeros((3, 2))
        >>> request = Request(np.zeros(5), [0.2, 0.0], stand[0], stand, Shapes.of([], dim=2), known_free=True)
        >>> RequestArrays.of([request]).mapped(lambda array: array[:0]).plan.shape
        (0, 3, 2)
        """
        return mapped(self, change)

    def rows(self, rows: list[int]) -> RequestArrays:
        """Return some of the requests, as NumPy arrays."""
        xp, device = array_api_compat.array_namespace(self.state), array_api_compat.device(self.state)
        index = xp.asarray(np.array(rows), device=device)
        some = self.mapped(lambda part: on_host(xp.take(part, index, axis=0)))
        return some if isinstance(self.model, str) else replace(some, model=[self.model[row] for row in rows])

    def row(self, index: int) -> Request:
        """Return the request of one robot, as NumPy arrays."""
        predicted, past = None, None
        if (sets := self.predicted) is not None and bool(sets.given[index]):
            center, half_width = on_host(sets.center[index]), on_host(sets.half_width[index])
            predicted = Prediction(center, half_width, float(sets.heading[index]))
        if (windows := self.past) is not None and bool(windows.given[index]):
            parts = on_host(windows.states[index]), on_host(windows.inputs[index])
            past = PastWindow(*parts, bool(windows.from_start[index]))
        state, action, input_in_force, plan = (on_host(getattr(self, name)[index]) for name in _ARRAYS)
        return Request(
            state,
            action,
            input_in_force,
            plan,
            obstacles=self.obstacles.of_row(index),
            model=self.model if isinstance(self.model, str) else self.model[index],
            predicted=predicted,
            known_free=bool(self.known_free[index]),
            turn_aside=self.turn_aside if isinstance(self.turn_aside, bool) else bool(self.turn_aside[index]),
            widening=1.0 if self.widening is None else float(self.widening[index]),
            state_widening=1.0 if self.state_widening is None else float(self.state_widening[index]),
            past=past,
            observation=np.zeros(0, np.float32) if self.observation is None else on_host(self.observation[index]),
            acceleration_age=self.acceleration_age,
        )


# The fields of a request that a batch has no place for, and how a program knows them
_NO_PLACE = {
    "movers": "moving obstacles",
    "scan": "a scan",
    "reservation": "a reservation",
    "other_reservations": "reservations of other robots",
}
_ARRAYS = ("state", "action", "input_in_force", "plan")


def _without_place(request: Request) -> list[str]:
    """Return what a request holds that a batch has no place for."""
    return [meaning for name, meaning in _NO_PLACE.items() if getattr(request, name) is not None]


def _stacked(name: str, owners: Sequence[Any]) -> Array:
    """Stack an attribute of requests. Raises BadRequest, with its name, if the shapes differ."""
    try:
        return np.array([getattr(owner, name) for owner in owners], dtype=float)
    except ValueError as error:
        raise BadRequest(name, f"{name} has not the same shape in all requests of a batch") from error


def _packed(requests: Sequence[Request], field: str, names: tuple[str, ...]) -> list[Array]:
    """Stack the parts of an optional field. A request without it gets those of another one; nothing reads them."""
    owners = [getattr(request, field) for request in requests]
    some = next((owner for owner in owners if owner is not None), None)
    if some is None:
        return [np.zeros(0)] * len(names)
    return [_stacked(name, [some if owner is None else owner for owner in owners]) for name in names]

"""The interface of every client of the filter, in process or over the bus.

answer = client.decide(state, action, obstacles)               # obstacles: at least those within sight
answer = client.decide(state, action, scan=scan)               # what the scan does not show to be free is occupied
answer = client.decide(state, action, [], known_free=True)     # a map says that all space within reach is free
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import Any, Protocol, runtime_checkable

import numpy as np
from numpy.typing import ArrayLike, NDArray

from brakeline.errors import BadRequest
from brakeline.messaging.obstacle import Obstacle
from brakeline.messaging.range_image import RangeImage
from brakeline.messaging.robot import Array, Robot
from brakeline.messaging.scan import Scan
from brakeline.messaging.sensor_messages import RangeMeasurement
from brakeline.safety.filter.backup_plan import BackupPlan
from brakeline.safety.filter.request import Decision


@dataclass(frozen=True, kw_only=True, eq=False)
class Answer(Decision):
    """A decision as a client returns it.

    >>> from brakeline import Filter, InProcess
    >>> answer = InProcess(Filter.load("ground")).decide(state=[0, 0, 0, 0, 0], action=[0.2, 0], known_free=True)
    >>> answer.kind, answer.action.tolist()
    ('allowed', [0.2, 0.0])

    Attributes:
        action: (m,) the input to execute next. This is the plan's first row. For a late robot it is the second row,
            because the first row is in force already.
        queue_ms: time from the service's receipt of the request to the decision; 0 in process.
        token_rejected: the request's plan token did not match its plan, so the service treated the plan as unverified.
        plan_tokens: the plan tokens of the next requests, in order; empty in process.
    """

    action: Array
    queue_ms: float = field(default=0.0, compare=False)
    token_rejected: bool = False
    plan_tokens: tuple[bytes, ...] = ()

    @staticmethod
    def of(decision: Decision, robot: Robot, **more: Any) -> Answer:
        """Return the answer with this decision; more: the attributes that a decision does not have."""
        return Answer(**vars(decision), action=decision.plan[robot.committed_steps].copy(), **more)


@runtime_checkable
class FilterClient(Protocol):
    """Requests decisions about one robot, and keeps its backup plan between two requests.

    >>> from brakeline import Filter, InProcess
    >>> isinstance(InProcess(Filter.load("ground")), FilterClient)
    True
    """

    @property
    def robot(self) -> Robot: ...

    @property
    def backup_plan(self) -> BackupPlan: ...

    def decide(
        self,
        state: ArrayLike,
        action: ArrayLike,
        obstacles: Iterable[Obstacle] | None = None,
        *,
        scan: RangeMeasurement | None = None,
        observation: ArrayLike | None = None,
        known_free: bool = False,
    ) -> Answer:
        """Request the decision on an action and commit to its plan. Then execute `answer.action` for one period.

        Call `decide` (or `fallback`) exactly once a period of the description. A program that calls it more often or
        more rarely executes other plans than the predicted ones, so the filter widens its sets.

        Args:
            state: (n,) measured, in the order and the units of the robot's description (`Robot.state`).
            action: (m,) proposed, in the order and the units of the description (`Robot.action`). If it holds NaN or
                infinity, the decision is a failsafe.
            obstacles: in the frame of the state's position; at least those within the robot's `sight` of the measured
                position (1 m for `ground`), and the moving ones that may come so near before a plan ends.
            scan: a sensor's measurement, instead of obstacles or in addition: a `Scan`, or a `RangeImage` in space.
                Fill it in with `brakeline.filled` first.
            observation: the task's observation. Only the rivals read it.
            known_free: whether all space within reach is free except for the obstacles. Set it if a map gave the
                obstacles. Without it, a request with neither obstacles nor a scan is an error.

        Raises:
            BadRequest: a value is missing, not finite, of the wrong size or of another type; `field` names it.
            BusError: there is no decision. Execute `fallback()` instead. In process there always is a decision.
        """

    def fallback(self) -> Array:
        """Return the backup plan's next input, for a period without a decision."""

    def reset(self) -> None:
        """Begin an episode with a robot that stands still."""


def vector_in(name: str, value: ArrayLike) -> Array:
    """Return an argument that is a vector, such as `state`. Raises BadRequest for another type or shape."""
    if value is None:
        raise BadRequest(name, f"{name} is missing: give a list of numbers")
    try:
        vector = np.asarray(value)
        if vector.dtype.kind not in "fiubO":  # texts and complex numbers can be converted, but not as they are meant
            raise TypeError(f"an array of {vector.dtype}")
        vector = np.asarray(vector, float)
        if isinstance(value, np.ma.MaskedArray):  # a masked number is missing
            vector = np.where(np.ma.getmaskarray(value), np.nan, vector)
    except (TypeError, ValueError, OverflowError) as error:
        raise BadRequest(name, f"{name} is a {type(value).__name__}: give a list of numbers") from error
    if vector.ndim != 1:
        raise BadRequest(name, f"{name} has shape {vector.shape}: give a list of numbers")
    return vector


def obstacles_in(value: Iterable[Obstacle] | None) -> list[Obstacle]:
    """Return the argument `obstacles` as a list; an empty one for None. Raises BadRequest for another type."""
    if isinstance(value, Scan | RangeImage):
        raise BadRequest("obstacles", f"obstacles is a {type(value).__name__}: give it as scan=")
    try:
        obstacles = [] if value is None else list(value)
    except TypeError as error:
        raise BadRequest("obstacles", f"obstacles is a {type(value).__name__}: give a list of Obstacle") from error
    for obstacle in obstacles:
        if not isinstance(obstacle, Obstacle):
            raise BadRequest("obstacles", f"obstacles holds a {type(obstacle).__name__}: give a list of Obstacle")
    return obstacles


def obstacle_lists(many: Iterable[Iterable[Obstacle] | None]) -> list[list[Obstacle] | None]:
    """Return the obstacles near each of many robots as lists. Raises BadRequest for another type.

    An iterator is at its end after its first use, as if all space were free. So each one is read once, also if several
    robots share it.
    """
    read: dict[int, list[Obstacle] | None] = {}
    kept = list(many)
    for one in kept:
        if id(one) not in read:
            read[id(one)] = None if one is None else obstacles_in(one)
    return [read[id(one)] for one in kept]


def scan_in(value: RangeMeasurement | None) -> RangeMeasurement | None:
    """Return the argument `scan`. Raises BadRequest for another type."""
    if value is not None and not isinstance(value, Scan | RangeImage):
        raise BadRequest("scan", f"scan is a {type(value).__name__}: give a Scan, in space a RangeImage")
    return value


def observation_in(value: ArrayLike | None) -> NDArray[np.float32]:
    """Return the argument `observation` as an array; an empty one for None. Raises BadRequest for another type."""
    if value is None:
        return np.zeros(0, np.float32)
    if isinstance(value, Scan | RangeImage):
        raise BadRequest("observation", f"observation is a {type(value).__name__}: give it as scan=")
    if isinstance(value, np.ndarray) and value.dtype == np.float32 and value.ndim == 1:
        return value
    return vector_in("observation", value).astype(np.float32)


def known_free_in(value: bool) -> bool:
    """Return the argument `known_free`. Raises BadRequest for another type."""
    if not isinstance(value, bool | np.bool_):
        raise BadRequest("known_free", f"known_free is a {type(value).__name__}: give True or False")
    return bool(value)


def accept(backup_plan: BackupPlan, answer: Answer) -> Array:
    """Commit to an answer's plan, and return `answer.action`, the input to execute next."""
    return backup_plan.accept(
        answer.plan,
        answer.model,
        answer.predicted,
        answer.verified,
        answer.plan_tokens,
        answer.reservation,
        answer.score,
        answer.judges,
        answer.outside_share,
        answer.plan_score,
        (answer.tube_center, answer.tube_half_width),
    )

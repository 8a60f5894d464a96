"""The interface of every asker, in process or over the bus: how it is asked, and what it answers.

answer = asker.decide(state, action, obstacles)                # obstacles: at least those within reach
answer = asker.decide(state, action, scan=scan)                # what the scan does not show to be free is occupied
answer = asker.decide(state, action, [], known_free=True)      # a map says that all space within reach is free
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any, Protocol, runtime_checkable

import numpy as np
from numpy.typing import ArrayLike, NDArray

from brakeline.messaging.obstacle import Obstacle
from brakeline.messaging.range_image import RangeImage
from brakeline.messaging.robot import Robot
from brakeline.messaging.scan import Scan
from brakeline.messaging.sensor_messages import RangeMeasurement
from brakeline.safety.filter.backup_plan import BackupPlan
from brakeline.safety.filter.request import BadRequest, Decision

Array = NDArray[np.float64]


@dataclass(frozen=True, kw_only=True)
class Answer(Decision):
    """A decision as the asker gets it.

    Attributes:
        action: (m,) the input to execute next. This is the plan's first row. For a late robot it is the second row,
            because the first row is in force already.
        queue_ms: time from the service's receipt of the question to the decision; 0 in process.
        token_rejected: the request's plan token did not match its plan, so the service treated the plan as unverified.
        plan_tokens: the plan tokens of the next requests, in order; empty in process.
    """

    action: Array
    queue_ms: float = 0.0
    token_rejected: bool = False
    plan_tokens: tuple[bytes, ...] = ()

    @staticmethod
    def of(decision: Decision, robot: Robot, **more: Any) -> Answer:
        """The answer that holds this decision; more: the attributes that a decision has not."""
        return Answer(**vars(decision), action=decision.plan[robot.committed_steps].copy(), **more)


@runtime_checkable
class FilterClient(Protocol):
    """Asks for decisions about one robot, and keeps its committed plan between two questions."""

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
        """Ask for the decision on an action and commit to its plan: then execute `answer.action`.

        Args:
            state: (n,) measured.
            action: (m,) proposed. NaN or infinity in it gives a failsafe.
            obstacles: at least those within reach (1 m is enough for `ground`).
            scan: what a sensor saw, in the obstacles' place or beside them: a `Scan`, in space a `RangeImage`. Fill it
                in by `brakeline.safety.perception.image_memory.filled`.
            observation: the task's own; only the rivals read it.
            known_free: nothing but the obstacles is near, so all other space within reach is free. Say it if a map gave
                the obstacles. Without it, a question with neither obstacles nor a scan is an error.

        Raises:
            BadRequest: a value is missing, not finite, of the wrong size or of another type; `field` names it.
            BusError: there is no decision; execute `fallback()` instead. In process there always is one.
        """

    def fallback(self) -> Array:
        """Take the committed plan's next input, for when there is no decision."""

    def reset(self) -> None:
        """Begin an episode, standing still."""


def obstacles_in(given: Iterable[Obstacle] | None) -> list[Obstacle]:
    """Return the obstacles that a program gave; none of None.

    Raises:
        BadRequest: it gave something else.
    """
    if isinstance(given, Scan | RangeImage):
        raise BadRequest("obstacles", f"obstacles is a {type(given).__name__}: give it as scan=")
    try:
        found = [] if given is None else list(given)
    except TypeError as error:
        raise BadRequest("obstacles", f"obstacles is a {type(given).__name__}: give a list of Obstacle") from error
    for one in found:
        if not isinstance(one, Obstacle):
            raise BadRequest("obstacles", f"obstacles holds a {type(one).__name__}: give a list of Obstacle")
    return found


def scan_in(given: RangeMeasurement | None) -> RangeMeasurement | None:
    """Return the scan that a program gave. Raises BadRequest: it gave something else."""
    if given is not None and not isinstance(given, Scan | RangeImage):
        raise BadRequest("scan", f"scan is a {type(given).__name__}: give a Scan, in space a RangeImage")
    return given


def observation_in(given: ArrayLike | None) -> NDArray[np.float32]:
    """Return the observation that a program gave; an empty one of None. Raises BadRequest: it gave something else."""
    if given is None:
        return np.zeros(0, np.float32)
    if isinstance(given, Scan | RangeImage):
        raise BadRequest("observation", f"observation is a {type(given).__name__}: give it as scan=")
    try:
        found = np.asarray(given, np.float32)
    except (TypeError, ValueError) as error:
        raise BadRequest("observation", f"observation is a {type(given).__name__}: give a list of numbers") from error
    if found.ndim != 1:
        raise BadRequest("observation", f"observation has shape {found.shape}: give a list of numbers")
    return found


def known_free_in(given: bool) -> bool:
    """Return whether a program said that space is known to be free. Raises BadRequest: it said something else."""
    if not isinstance(given, bool | np.bool_):
        raise BadRequest("known_free", f"known_free is a {type(given).__name__}: give True or False")
    return bool(given)


def accept(backup_plan: BackupPlan, answer: Answer) -> Array:
    """Commit to an answer's plan; returns the input to execute next, which is `answer.action`."""
    return backup_plan.accept(
        answer.plan, answer.model, answer.predicted, answer.verified, answer.plan_tokens, answer.reservation
    )

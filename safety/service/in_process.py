"""A client of the filter, or of a rival, in the program's own process.

safety = InProcess(Filter(ModelSet.load(path)))
answer = safety.decide(state, action, obstacles)
drive(answer.action)                  # once a period; call `safety.reset()` at the start of an episode
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray

from brakeline.messaging.moving_obstacles import split_moving
from brakeline.messaging.obstacle import Obstacle
from brakeline.messaging.robot import Array, Robot
from brakeline.messaging.sensor_messages import RangeMeasurement
from brakeline.safety.filter.backup_plan import BackupPlan
from brakeline.safety.filter.request import MOST_OBSERVED, Request
from brakeline.safety.service.filter_client import (
    Answer,
    accept,
    known_free_in,
    observation_in,
    obstacles_in,
    scan_in,
    vector_in,
)
from brakeline.safety.service.obstacle_frame import ObstacleFrame

if TYPE_CHECKING:
    from brakeline.safety.methods import Method


class InProcess:
    """Requests decisions about one robot from a method, and keeps its backup plan: `SafetyClient` without a service.

    >>> from brakeline.safety.filter.filter import Filter
    >>> safety = InProcess(Filter.load("ground"))
    >>> safety.decide(state=[0, 0, 0, 0, 0], action=[0.2, 0], known_free=True).kind
    'allowed'
    """

    def __init__(self, method: Method, accept_bound: float | None = None, acceleration_age: float = 0.0) -> None:
        """Make a client.

        Args:
            method: the filter or a rival.
            accept_bound: largest accepted probability that a verified plan leaves its tube, as the model set's
                validation report states it. Defaults to the limit in the robot's description.
            acceleration_age: age of the horizontal acceleration in your states [s].

        Raises:
            TypeError: `method` is neither the filter nor a rival.
            TooLoose: the report states a larger probability, or there is no report.
        """
        if not hasattr(method, "observed"):  # clients and fleets decide too, on other arguments
            raise TypeError(f"a filter is needed here, not a {type(method).__name__}: give Filter.load(NAME_OR_PATH)")
        from brakeline.safety.model.stated_bound import check_bound  # a client of a service loads no model

        check_bound(getattr(method, "model", None), method.robot, accept_bound)
        self.method = method
        self.backup_plan = BackupPlan(method.robot, acceleration_age=acceleration_age)
        self._frame = ObstacleFrame(method.robot)

    @property
    def robot(self) -> Robot:
        return self.method.robot

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
        """Decide on an action and commit to its plan, as `FilterClient.decide`. Then execute `answer.action`.

        Raises:
            BadRequest, BadShape: a value is missing, not finite, or has the wrong size or type; `field` names it.
        """
        listed = None if obstacles is None else obstacles_in(obstacles)
        request = self.request(
            self.backup_plan, state, action, listed, scan=scan, observation=observation, known_free=known_free
        )
        self._frame.see(request.state, listed)
        return self.decide_all([self.backup_plan], [request])[0]

    def decide_all(self, backup_plans: Sequence[BackupPlan], requests: Sequence[Request]) -> list[Answer]:
        """Decide for several robots of the kind, each with its own backup plan and its `request`.

        The filter decides on many at once (`Filter.decide_all`).

        Raises:
            BadRequest, BadShape: see `decide`. Then no backup plan has changed.
        """
        many = getattr(self.method, "decide_all", None)  # the rivals decide one by one
        decisions = many(requests) if many else [self.method.decide(request) for request in requests]
        answers = [Answer.of(decision, self.robot) for decision in decisions]
        for backup_plan, answer in zip(backup_plans, answers, strict=True):
            accept(backup_plan, answer)
        return answers

    def fallback(self) -> Array:
        """Return the backup plan's next input, for a period without a decision."""
        return self.backup_plan.fallback()

    def reset(self) -> None:
        """Begin an episode with a robot that stands still."""
        self.backup_plan.reset()
        self._frame.reset()

    def request(
        self,
        backup_plan: BackupPlan,
        state: ArrayLike,
        action: ArrayLike,
        obstacles: Iterable[Obstacle] | None = None,
        *,
        scan: RangeMeasurement | None = None,
        observation: ArrayLike | None = None,
        known_free: bool = False,
    ) -> Request:
        """Return the request about a robot with this backup plan. Raises BadRequest if a value has another type."""
        measured = vector_in("state", state)
        backup_plan.measured(measured)
        standing, moving = split_moving(obstacles_in(obstacles), self.robot.position_dim)
        return Request(
            state=measured,
            action=vector_in("action", action),
            input_in_force=backup_plan.input_in_force,
            plan=backup_plan.plan,
            obstacles=standing,
            movers=moving,
            scan=scan_in(scan),
            model=backup_plan.model,
            predicted=backup_plan.predicted,
            observation=observation_in(observation),
            known_free=known_free_in(known_free),
            turn_aside=backup_plan.turn_aside,
            acceleration_age=backup_plan.acceleration_age,
            widening=backup_plan.widening.factor,
            state_widening=backup_plan.widening.state_factor,
            past=backup_plan.past,
        )


def request_observation(observation: object) -> NDArray[np.float32]:
    """Return the observation if a request can hold it, a vector of finite numbers; otherwise an empty one.

    Only the rivals read observations. Other environments may observe an image or a dict.
    """
    empty = np.zeros(0, np.float32)
    if not isinstance(observation, np.ndarray) or observation.ndim != 1 or observation.dtype.kind not in "fiu":
        return empty
    if observation.size > MOST_OBSERVED or not np.isfinite(observation).all():
        return empty
    return observation.astype(np.float32)

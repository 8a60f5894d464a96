"""The filter (or a rival) without a service and without an environment: what a program asks in its own process.

safety = InProcess(Filter(ModelSet.load(path)))
answer = safety.decide(state, action, obstacles)
drive(answer.action)                  # and next period again; `safety.reset()` where an episode begins, standing still
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray

from brakeline.messaging.moving_obstacles import split_moving
from brakeline.messaging.obstacle import Obstacle
from brakeline.messaging.robot import Robot
from brakeline.messaging.sensor_messages import RangeMeasurement
from brakeline.safety.filter.backup_plan import BackupPlan
from brakeline.safety.filter.request import MOST_OBSERVED, Request
from brakeline.safety.service.filter_client import Answer, accept, known_free_in, observation_in, obstacles_in, scan_in

if TYPE_CHECKING:
    from brakeline.safety.methods import Method

Array = NDArray[np.float64]


class InProcess:
    """Asks a method about one robot, and keeps its committed plan: `SafetyClient` without a service."""

    def __init__(self, method: Method, accept_bound: float | None = None) -> None:
        """accept_bound: the largest stated share of plans outside their tubes that is accepted; unless given the limit
        of the robot's description counts.

        Raises:
            TooLoose: the model set states more, or states nothing.
        """
        from brakeline.safety.model.stated_bound import check_bound  # what only asks a service loads no model

        check_bound(getattr(method, "model", None), method.robot, accept_bound)
        self.method = method
        self.backup_plan = BackupPlan(method.robot)

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
        """Decide on an action and commit to its plan, as `FilterClient` says: then execute `answer.action`.

        Raises:
            BadRequest, BadShape: a value is missing, not finite, of the wrong size or type; `field` names it.
        """
        return self.decide_all(
            [self.backup_plan],
            [state],
            [action],
            [obstacles],
            scans=[scan],
            observations=[observation],
            known_free=[known_free],
        )[0]

    def decide_all(
        self,
        backup_plans: Sequence[BackupPlan],
        states: Sequence[ArrayLike],
        actions: Sequence[ArrayLike],
        obstacles: Sequence[Iterable[Obstacle] | None],
        *,
        scans: Sequence[RangeMeasurement | None],
        observations: Sequence[ArrayLike | None],
        known_free: Sequence[bool],
    ) -> list[Answer]:
        """The same of several robots of the kind, each with a commitment of its own. Raises as `decide` does, before
        any plan is committed to."""
        asked = zip(backup_plans, states, actions, obstacles, scans, observations, known_free, strict=True)
        answers = [Answer.of(self.method.decide(self._request(*one)), self.robot) for one in asked]
        for kept, answer in zip(backup_plans, answers, strict=True):
            accept(kept, answer)
        return answers

    def fallback(self) -> Array:
        """The committed plan's next input, for when there is no decision."""
        return self.backup_plan.fallback()

    def reset(self) -> None:
        """An episode begins, standing still."""
        self.backup_plan.reset()

    def _request(
        self,
        kept: BackupPlan,
        state: ArrayLike,
        action: ArrayLike,
        obstacles: Iterable[Obstacle] | None,
        scan: RangeMeasurement | None,
        observation: ArrayLike | None,
        known_free: bool,
    ) -> Request:
        measured = np.asarray(state, dtype=float)
        kept.measured(measured)
        standing, moving = split_moving(obstacles_in(obstacles), self.robot.position_dim)
        return Request(
            state=measured,
            action=np.asarray(action, dtype=float),
            input_in_force=kept.input_in_force,
            plan=kept.plan,
            obstacles=standing,
            movers=moving,
            scan=scan_in(scan),
            model=kept.model,
            predicted=kept.predicted,
            observation=observation_in(observation),
            known_free=known_free_in(known_free),
        )


def request_observation(observation: object) -> NDArray[np.float32]:
    """Return the observation as a request holds it: a list of finite numbers, or an empty one.

    Only the rivals read observations. Another environment may observe an image or a dict: a request holds none of it.
    """
    empty = np.zeros(0, np.float32)
    if not isinstance(observation, np.ndarray) or observation.ndim != 1 or observation.dtype.kind not in "fiu":
        return empty
    if observation.size > MOST_OBSERVED or not np.isfinite(observation).all():
        return empty
    return observation.astype(np.float32)

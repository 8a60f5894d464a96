"""A client of the safety service for robots that share a world: one query for all, each with its reservation.

with FleetClient.open("tcp/127.0.0.1:7447", "ground", ["left", "right"]) as fleet:
    answers = fleet.decide(states, actions, obstacles)   # one of each for each robot, in the order of the names
    drive([answer.action for answer in answers])         # once a period; if it raises: drive(fleet.fallback())
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Self

from numpy.typing import ArrayLike

from brakeline.messaging.bus import Bus
from brakeline.messaging.obstacle import Obstacle
from brakeline.messaging.robot import Array, Robot
from brakeline.messaging.sensor_messages import RangeMeasurement
from brakeline.safety.filter.backup_plan import BackupPlan
from brakeline.safety.service.client import (
    DEADLINE,
    BusClient,
    read_reply,
    request_message,
)
from brakeline.safety.service.filter_client import Answer, accept, obstacle_lists
from brakeline.safety.service.service_query import query_service
from brakeline.safety.service.wire import MAX_REQUESTS


class FleetClient(BusClient):
    """Requests decisions about all robots of a world, and keeps their backup plans and reservations (docs/fleets.md).

    Each period, call `decide` once, or `fallback` if that raised. The robots stand still at the start. Use a client in
    one thread at a time.

    >>> with FleetClient.open(ENDPOINT, "ground", ["left", "right"], deadline=5.0) as fleet:
    ...     answers = fleet.decide([[0, 1, 0, 0, 0], [0, -1, 0, 0, 0]], [[0.25, 0], [0.25, 0]], known_free=True)
    >>> [answer.kind for answer in answers]
    ['allowed', 'allowed']
    """

    def __init__(
        self,
        bus: Bus,
        robot: Robot | Path | str,
        names: Sequence[str],
        deadline: float = DEADLINE,
        acceleration_age: float = 0.0,
    ) -> None:
        """Make a client for robots of one kind; names: of the robots. acceleration_age: see `SafetyClient`.

        Raises:
            ValueError: there are fewer than two names, or more than a service decides on at once, or two are equal, or
                the robot has no position, or drives in real time; or the deadline is not above 0 and at most a day.
        """
        if isinstance(names, str) or len(names) < 2 or len(set(names)) < len(names):
            raise ValueError(f"a fleet needs two robots or more with different names, not {names!r:.80}")
        if len(names) > MAX_REQUESTS:
            raise ValueError(f"a fleet has at most {MAX_REQUESTS} robots, not {len(names)}: a service refuses more")
        super().__init__(bus, robot, deadline)
        if not self.robot.position_dim:
            raise ValueError(f"{self.robot.name} has no position, so it reserves no space: use a SafetyClient for each")
        if self.robot.late:
            raise ValueError(f"{self.robot.name} gets its decisions too late for reservations: drive it in lockstep")
        self.names = tuple(names)
        self.backup_plans = [BackupPlan(self.robot, acceleration_age=acceleration_age) for _ in self.names]
        self._episode = self._step = 0

    @classmethod
    def open(
        cls,
        connect: str | Sequence[str],
        robot: Robot | Path | str,
        names: Sequence[str],
        deadline: float = DEADLINE,
        keys: Path | str | None = None,
        name: str = "client",
        acceleration_age: float = 0.0,
    ) -> Self:
        """Return a client with a bus of its own. For the other arguments and errors, see `SafetyClient.open`."""
        return cls._opened(connect, keys, name, robot, names, deadline, acceleration_age)

    def decide(
        self,
        states: Sequence[ArrayLike],
        actions: Sequence[ArrayLike],
        obstacles: Sequence[Iterable[Obstacle] | None] | None = None,
        *,
        scans: Sequence[RangeMeasurement | None] | None = None,
        known_free: bool = False,
    ) -> list[Answer]:
        """Request the decisions on all actions and commit to their plans. Then execute every `answer.action`.

        Args:
            states: (n,) of each robot, measured at one time.
            actions: (m,) of each robot, proposed.
            obstacles: near each robot, without the other robots: their reservations keep the robots apart.
            scans: of each robot, instead of obstacles or in addition.
            known_free: whether all space near the robots is free except for the obstacles and the other robots. Without
                it, a robot with neither obstacles nor a scan is an error.

        Raises:
            BadRequest: a value has another type; `field` names it.
            ValueError: there is not one state, action, ... for each robot.
            NoReply, Late, Refused, SafetyError: one robot has no decision. Then no robot has, because the other plans
                may depend on it. Execute all inputs of `fallback()` instead.
        """
        nothing: list[None] = [None] * len(self.names)
        local_maps = nothing if obstacles is None else obstacles, nothing if scans is None else scans
        for name, values in zip(
            ("states", "actions", "obstacles", "scans"), (states, actions, *local_maps), strict=True
        ):
            if len(values) != len(self.names):
                raise ValueError(f"{name} has {len(values)} entries: give one for each of {', '.join(self.names)}")
        near, seen = obstacle_lists(local_maps[0]), local_maps[1]
        robots = zip(self.names, self.backup_plans, states, actions, near, seen, strict=True)
        requests = [
            request_message(
                backup_plan,
                state,
                action,
                obstacles_near,
                scan=scan,
                known_free=known_free,
                actor=name,
                episode=self._episode,
                step=self._step,
                fleet=self.names,
            )
            for name, backup_plan, state, action, obstacles_near, scan in robots
        ]
        replies = zip(query_service(self.bus, requests, self.deadline), requests, strict=True)
        answers = [read_reply(reply, request, self.robot) for reply, request in replies]
        for backup_plan, answer in zip(self.backup_plans, answers, strict=True):
            accept(backup_plan, answer)
        self._step += 1
        return answers

    def fallback(self) -> list[Array]:
        """Return the backup plans' next inputs, for a period without decisions: all brake inside their reservations."""
        self._step += 1
        return [backup_plan.fallback() for backup_plan in self.backup_plans]

    def reset(self) -> None:
        """Begin an episode with robots that stand still and have no reservations."""
        for backup_plan in self.backup_plans:
            backup_plan.reset()
        self._episode, self._step = self._episode + 1, 0

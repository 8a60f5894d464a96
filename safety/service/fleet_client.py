"""How any program asks the safety service about robots that share a world: all in one question, each with its promise.

with FleetClient.open("tcp/127.0.0.1:7447", "ground", ["left", "right"]) as fleet:
    answers = fleet.decide(states, actions, obstacles)   # one of each for each robot, in the order of their names
    drive([answer.action for answer in answers])         # and next period again; if it raises: drive(fleet.fallback())
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Self

from numpy.typing import ArrayLike

from brakeline.messaging.bus import Bus
from brakeline.messaging.obstacle import Obstacle
from brakeline.messaging.robot import Robot
from brakeline.messaging.sensor_messages import RangeMeasurement
from brakeline.safety.filter.backup_plan import BackupPlan
from brakeline.safety.service.client import (
    DEADLINE,
    Array,
    BusClient,
    bus_at,
    query_service,
    read_reply,
    request_message,
)
from brakeline.safety.service.filter_client import Answer, accept


class FleetClient(BusClient):
    """Asks about all robots of a world, and keeps each one's committed plan and promise (docs/fleets.md).

    Time passes for all of them or for none: each period is one `decide`, or one `fallback` where that raised. They
    begin standing still. Not for several threads at once.
    """

    def __init__(self, bus: Bus, robot: Robot | str, names: Sequence[str], deadline: float = DEADLINE) -> None:
        """robot: what all of them are; names: by which the service tells them apart.

        Raises:
            ValueError: fewer than two names, or one twice.
        """
        if len(names) < 2 or len(set(names)) < len(names):
            raise ValueError(f"a fleet has two robots or more, each with a name of its own, not {list(names)}")
        super().__init__(bus, robot, deadline)
        self.names = tuple(names)
        self.backup_plans = [BackupPlan(self.robot) for _ in self.names]
        self._episode = self._step = 0

    @classmethod
    def open(
        cls,
        connect: str | Sequence[str],
        robot: Robot | str,
        names: Sequence[str],
        deadline: float = DEADLINE,
        keys: Path | str | None = None,
        name: str = "client",
    ) -> Self:
        """A client with a bus of its own. Arguments and errors are those of `SafetyClient.open`."""
        client = cls(bus_at(connect, keys, name), robot, names, deadline)
        client._owned = True
        return client

    def decide(
        self,
        states: Sequence[ArrayLike],
        actions: Sequence[ArrayLike],
        obstacles: Sequence[Iterable[Obstacle] | None] | None = None,
        *,
        scans: Sequence[RangeMeasurement | None] | None = None,
        known_free: bool = False,
    ) -> list[Answer]:
        """The decisions; their plans are committed to, so execute every `answer.action`.

        Args:
            states: measured, at one time; actions: proposed; obstacles: near each robot, what stands still. The others
            are not among them: the service keeps each off what the others promise. scans: of each robot, in the
            obstacles' place or beside them; known_free: nothing but the obstacles and the other robots is near any of
            them, so all other space is free. Without it, a robot with neither obstacles nor a scan is an error.

        Raises:
            BadRequest: a value is of another type; `field` names it.
            ValueError: not one of each for each robot.
            NoReply, Late, Refused, SafetyError: no decision about one robot, so none about any, for the others' new
            plans may rest on that one's: execute `fallback()` instead, all of it.
        """
        nothing: list[None] = [None] * len(self.names)
        map_for_display = nothing if obstacles is None else obstacles, nothing if scans is None else scans
        asked = zip(self.names, self.backup_plans, states, actions, *map_for_display, strict=True)
        requests = [
            request_message(
                kept,
                state,
                action,
                near,
                scan=scan,
                known_free=known_free,
                actor=name,
                episode=self._episode,
                step=self._step,
                fleet=self.names,
            )
            for name, kept, state, action, near, scan in asked
        ]
        replies = zip(query_service(self.bus, requests, self.deadline), requests, strict=True)
        answers = [read_reply(reply, request, self.robot) for reply, request in replies]
        for kept, answer in zip(self.backup_plans, answers, strict=True):
            accept(kept, answer)
        self._step += 1
        return answers

    def fallback(self) -> list[Array]:
        """The committed plans' next inputs, for when there is no decision: all brake along what they promised."""
        self._step += 1
        return [kept.fallback() for kept in self.backup_plans]

    def reset(self) -> None:
        """They stand somewhere else, and have promised each other nothing."""
        for kept in self.backup_plans:
            kept.reset()
        self._episode, self._step = self._episode + 1, 0

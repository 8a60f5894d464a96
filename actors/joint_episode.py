"""The robots of one world: they begin together, are asked about in one question, and move when all are decided.

A robot that is at its goal, or has touched something, stands until the others are done, and is asked about as before:
they have to know where it is.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any, Protocol

from brakeline.actors.decision_guard import DecisionOutcome
from brakeline.actors.episode_runner import Environment, EpisodeRunner, StepResult
from brakeline.messaging import brakeline_pb2 as pb
from brakeline.safety.filter.backup_plan import Array


class SharedWorld(Protocol):
    """Several robots in one physics: `brakeline.sim.shared_world.FleetEnv`."""

    @property
    def members(self) -> Sequence[Environment]:
        """A robot's own environment, for all but its steps."""

    def draw(self, episode_seed: int) -> None:
        """A fresh world; then each member is to be reset."""

    def step(self, inputs: Sequence[Array]) -> list[Any]:
        """One period of all robots: what each member's `step` would return."""


class RobotGroup:
    """The drivers of one world."""

    def __init__(self, world: SharedWorld, drivers: Sequence[EpisodeRunner], promising: bool = True) -> None:
        """promising: they ask for promises; without, they know nothing of each other."""
        self.world, self.drivers = world, list(drivers)
        for driver in self.drivers:
            driver.size = len(self.drivers)
            driver.fleet = tuple(d.identity.actor for d in self.drivers) if promising else ()

    @property
    def running(self) -> bool:
        return any(driver.running for driver in self.drivers)

    def begin(self, episode: int) -> list[pb.Episode]:
        """A fresh world, which follows from the episode's number; every robot stands at its start."""
        self.world.draw(self.drivers[0].identity.episode_seed(episode))
        return [driver.begin(episode) for driver in self.drivers]

    def requests(self, proposals: Sequence[Array]) -> list[pb.Request]:
        return [driver.request(proposal) for driver, proposal in zip(self.drivers, proposals, strict=True)]

    def execute(
        self,
        proposals: Sequence[Array],
        outcomes: Sequence[DecisionOutcome | None],
        versions: Sequence[int] | None = None,
    ) -> list[pb.Step | None]:
        """One period of all; None for those whose episode was over."""
        told = list(zip(self.drivers, proposals, joint_outcomes(outcomes), strict=True))
        inputs = [driver.command(proposal, outcome) for driver, proposal, outcome in told]
        results: list[StepResult] = self.world.step(inputs)
        versions = versions or [0] * len(told)
        steps: list[pb.Step | None] = []
        for (driver, proposal, outcome), action, result, version in zip(told, inputs, results, versions, strict=True):
            if driver.running:
                steps.append(driver.took(proposal, outcome, action, result, version))
            else:
                driver.stood(result)
                steps.append(None)
        return steps


def joint_outcomes(outcomes: Sequence[DecisionOutcome | None]) -> list[DecisionOutcome | None]:
    """If there is no answer about one robot there is none about any: the others' new plans may rest on that one's."""
    missing = next((o for o in outcomes if o is not None and o.answer is None), None)
    if missing is None:
        return list(outcomes)
    why = f"no answer about {missing.request.actor}, so none about its fleet: {missing.failure}"
    return [o if o is None or o.answer is None else replace(o, answer=None, reply=None, failure=why) for o in outcomes]

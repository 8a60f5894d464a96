"""Decide which steps count in the figures: those that a learner would take, by what it has published."""

from __future__ import annotations

from dataclasses import dataclass

from brakeline.messaging import brakeline_pb2 as pb
from brakeline.messaging.topics import AHEAD

MOST_WAITING = 1000  # steps of each robot


@dataclass(slots=True)
class LastStep:
    """The last step of one start of an actor."""

    index: int = 0
    place: tuple[int, int] = (-1, -1)  # episode and step


class StepAdmission:
    """Refuses steps that are repeated, that go back, or that no learner permitted.

    A log may lack a learner's latest permission, because its recorder was killed or cut off. Steps beyond the known
    permission wait for the next one. Until then they are refused.
    """

    def __init__(self) -> None:
        self._refused = 0
        self._limits: dict[str, dict[str, int]] = {}  # by robot and actor: the learner's latest
        self._last: dict[tuple[str, int], LastStep] = {}
        self._waiting: dict[str, list[pb.Step]] = {}  # by robot

    @property
    def refused(self) -> int:
        return self._refused + sum(map(len, self._waiting.values()))

    def learner(self, metrics: pb.LearnerMetrics) -> list[pb.Step]:
        """Note up to which step each actor may go. Returns the steps that waited for it, and that count now."""
        if not metrics.limit:
            return []
        self._limits[metrics.robot] = dict(metrics.limit)
        return [step for step in self._waiting.pop(metrics.robot, []) if self.admit(step)]

    def admit(self, step: pb.Step) -> bool:
        """Return whether the step counts. Call it once a step, in the order of publication."""
        last = self._last.setdefault((step.actor, step.header.run), LastStep())
        place = step.episode, step.step
        goes_on = step.index == 0 or (step.index > last.index and place > last.place)  # old logs have no index
        limits = self._limits.get(step.robot)
        if goes_on and (limits is None or 0 < step.index <= limits.get(step.actor, 0) + AHEAD):
            last.index, last.place = step.index, place
            return True
        waiting = self._waiting.setdefault(step.robot, [])
        if goes_on and step.index > 0 and len(waiting) < MOST_WAITING:
            waiting.append(step)
        else:
            self._refused += 1
        return False

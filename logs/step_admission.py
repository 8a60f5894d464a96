"""Decide which steps count in the figures: those that a learner would take, by what it has published."""

from __future__ import annotations

from dataclasses import dataclass

from brakeline.messaging import brakeline_pb2 as pb
from brakeline.messaging.flow_limits import AHEAD


@dataclass(slots=True)
class LastStep:
    """The last step of one start of an actor."""

    index: int = 0
    place: tuple[int, int] = (-1, -1)  # episode and step


class StepAdmission:
    """Refuses steps that are repeated, that go back, or that no learner permitted.

    Attributes:
        refused: number of refused steps.
    """

    def __init__(self) -> None:
        self.refused = 0
        self._limits: dict[str, dict[str, int]] = {}  # by robot and actor: the learner's latest
        self._last: dict[tuple[str, int], LastStep] = {}

    def learner(self, metrics: pb.LearnerMetrics) -> None:
        """Note up to which step each actor may go."""
        if metrics.limit:
            self._limits[metrics.robot] = dict(metrics.limit)

    def admit(self, step: pb.Step) -> bool:
        """Return whether the step counts. Call it once a step, in the order of publication."""
        last = self._last.setdefault((step.actor, step.header.run), LastStep())
        place = step.episode, step.step
        goes_on = step.index == 0 or (step.index > last.index and place > last.place)  # old logs have no index
        limits = self._limits.get(step.robot)
        if not goes_on or (limits is not None and not 0 < step.index <= limits.get(step.actor, 0) + AHEAD):
            self.refused += 1
            return False
        last.index, last.place = step.index, place
        return True

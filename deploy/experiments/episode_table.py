"""One row of figures for each episode, as the cells of a comparison, campaigns and evaluations store it."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from operator import add

from brakeline.logs.quantiles import QuantileSketch, summary
from brakeline.messaging import brakeline_pb2 as pb

CONTACTS = ("contact_moving", "contact_standing")
INTERVENTIONS = (pb.FAILSAFE, pb.ADJUSTED, pb.RECOVERING)


@dataclass(frozen=True)
class Column:
    """A column of an `EpisodeTable`: the value of each step, how an episode combines them, and its type in JSON."""

    value: Callable[[pb.Step], float]
    combine: Callable[[float, float], float] = add
    count: bool = False
    start: float = 0  # before the first step


COLUMNS = {
    "steps": Column(lambda step: 1, count=True),
    "goal": Column(lambda step: step.goal, count=True),
    "collision": Column(lambda step: step.collision, max, count=True),
    "timeout": Column(lambda step: step.truncated and not step.terminated and not step.cut, count=True),
    "reward": Column(lambda step: step.reward),  # without penalties
    "speed": Column(lambda step: step.speed),  # m/s, summed over steps
    "fastest": Column(lambda step: step.speed, max),
    "interventions": Column(lambda step: step.fallback or step.decision in INTERVENTIONS, count=True),
    "milliseconds": Column(lambda step: step.propose_ms + step.decide_ms),  # of policy and method
    "contact_moving": Column(lambda step: step.contact_moving, count=True),
    "contact_standing": Column(lambda step: step.contact_standing, count=True),
}


@dataclass
class EpisodeTable:
    """One row per finished episode with the values of its columns, and statistics of the decision times.

    Steps of several actors may alternate.

    Attributes:
        rows: in the order in which the episodes ended.
        spans: for each row, the number of steps, of all actors, before its first step and after its last one.
    """

    which: Mapping[str, Column] = field(default_factory=lambda: COLUMNS)
    rows: list[dict[str, float]] = field(default_factory=list)
    spans: list[tuple[int, int]] = field(default_factory=list)
    decisions: int = 0
    times: QuantileSketch = field(default_factory=QuantileSketch)  # decision times [ms]
    _running: dict[str, tuple[int, dict[str, float]]] = field(default_factory=dict)  # by actor: begin, row

    def step(self, step: pb.Step) -> None:
        """Add the next step of an actor."""
        if step.actor not in self._running:
            self._running[step.actor] = self.decisions, {name: column.start for name, column in self.which.items()}
        begin, row = self._running[step.actor]
        for name, column in self.which.items():
            row[name] = column.combine(row[name], column.value(step))
        self.decisions += 1
        self.times.add(COLUMNS["milliseconds"].value(step))
        if step.terminated or step.truncated:
            del self._running[step.actor]
            self.rows.append(row)
            self.spans.append((begin, self.decisions))

    def pop(self) -> dict[str, float]:
        """Remove the row of the episode that ended last, and return it."""
        self.spans.pop()
        return self.rows.pop()

    def columns(self) -> dict[str, list[float]]:
        """Return the columns in the order in which the episodes began, rounded to four digits; counts are integers."""
        rows = [self.rows[i] for i in self._order()]
        return {
            name: [int(row[name]) if column.count else round(float(row[name]), 4) for row in rows]
            for name, column in self.which.items()
        }

    def span_columns(self) -> dict[str, list[int]]:
        """Return the columns `begin` and `end` of `spans`, in the order of `columns`."""
        spans = [self.spans[i] for i in self._order()]
        return {"begin": [begin for begin, _ in spans], "end": [end for _, end in spans]}

    def _order(self) -> list[int]:
        return sorted(range(len(self.rows)), key=self.spans.__getitem__)

    def decision_ms(self) -> dict[str, float]:
        """Return the mean and the standard deviation of the decision times [ms]."""
        whole = summary(self.times)
        return {name: whole[name] if whole else 0.0 for name in ("mean", "std")}

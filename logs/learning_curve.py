"""Compute learning curves: rates over the steps of all actors of a robot kind, in a bounded number of bins.

When all bins are used, each two neighbours become one bin of twice the width. Learning curves depend on the order in
which the steps of different actors arrive, so they are not part of `Metrics`.
"""

from __future__ import annotations

import math
from collections import Counter, defaultdict, deque
from dataclasses import dataclass

from brakeline.logs.decision_explanation import plan_score
from brakeline.logs.episode_stats import INTERVENTIONS, Figures, StepSequence, closest_of, kind_of
from brakeline.logs.json_values import finite
from brakeline.logs.quantiles import QuantileSketch, summary
from brakeline.messaging import brakeline_pb2 as pb

MOST_BINS = 200
FIRST_WIDTH = 50  # steps
LAST = 100  # latest episodes that the report summarizes
MOST_POINTS = 400  # points of a learner's curves
MOST_MODELS = 1000  # versions whose first decision is kept
CURVES = ("steps", "updates", "critic_loss", "actor_loss", "mean_q")  # of the learner

COUNTED = {int(pb.ADJUSTED): "adjusted", int(pb.FAILSAFE): "failsafes", int(pb.RECOVERING): "recovering"}


def interventions_in(row: Figures) -> float:
    """Return the share of steps with an intervention in a row of `bins`. Rows of earlier versions lack `recovering`."""
    return float(row["adjusted"] + row["failsafes"] + row.get("recovering", 0.0))


class Bin(Counter[str]):
    """Sums over consecutive steps and over the episodes that ended in them, by name."""

    reward = 0.0  # of the `whole` ones of these episodes, without the intervention penalty
    closest = math.inf  # m
    widening = 1.0  # the largest of a request
    half_width = 0.0  # m, sum over the tubes of their largest half-width

    def join(self, other: Bin) -> None:
        self.update(other)
        self.reward += other.reward
        self.closest = min(self.closest, other.closest)
        self.widening = max(self.widening, other.widening)
        self.half_width += other.half_width

    def sets(self) -> Figures:
        """Return how much of their sets the windows in the bin used, and how wide the tubes were.

        None: no window, and no widened request; of `slowed`, no limited proposal (`brakeline.actors.slow_down`).
        """
        scored, tubes = self["scored"], self["tubes"]
        adapts = scored or self.widening > 1.0
        return {
            "beyond": self["beyond"] / scored if scored else None,
            "beyond_widened": self["beyond_widened"] / scored if scored else None,
            "widening": self.widening if adapts else None,
            "half_width": self.half_width / tubes if tubes and adapts else None,
            "slowed": self["slowed"] / self["exchanges"] if self["slowed"] else None,
        }


@dataclass
class Episode:
    """Sums over a running episode."""

    number: int
    steps: int = 0
    interventions: int = 0
    reward: float = 0.0  # without the intervention penalty
    whole: bool = True  # no part of the episode is missing
    goal: bool = False
    collision: bool = False


class LearningCurve:
    """The learning curves of one robot kind, from its steps in the order of arrival.

    Attributes:
        recorded: number of steps.
    """

    def __init__(self) -> None:
        self.width = FIRST_WIDTH
        self.bins: list[Bin] = [Bin()]
        self.staleness = QuantileSketch()  # versions between a step's weights and the newest known weights
        self.last: deque[Episode] = deque(maxlen=LAST)
        self._running: dict[str, Episode] = {}
        self._sequences: defaultdict[str, StepSequence] = defaultdict(StepSequence)  # by actor
        self._learned: list[tuple[float, ...]] = []  # points with the values of CURVES
        self._stride = 1  # learner messages per point
        self._messages = 0
        self._newest = 0
        self.recorded = 0
        self._models: dict[str, int] = {}  # step at which a version of the model set decided first

    def step(self, step: pb.Step) -> None:
        now = self._bin()
        now["steps"] += 1
        self.recorded += 1
        kind = kind_of(step)
        if kind in COUNTED:
            now[COUNTED[kind]] += 1
        closest = closest_of(step)
        if closest < now.closest:
            now.closest = closest
        version = step.weights_version
        if version > self._newest:
            self._newest = version
        self.staleness.add(self._newest - version)
        actor = step.actor
        episode, sequence = self._running.get(actor), self._sequences[actor]
        begins = episode is None or step.step == 0 or step.episode != episode.number
        sequence.add(step, begins)
        if episode is None or begins:
            episode = self._running[actor] = Episode(step.episode)
        episode.reward += step.reward
        episode.steps += 1
        episode.interventions += kind in INTERVENTIONS
        if step.collision and not episode.collision:
            episode.collision = True
            now["collisions"] += 1
        if step.terminated or step.truncated:
            episode.goal, episode.whole = step.goal, sequence.whole
            now["episodes"] += 1
            now["goals"] += step.goal
            if sequence.whole:
                now["whole"] += 1
                now.reward += episode.reward
            self.last.append(self._running.pop(actor))

    def exchange(self, exchange: pb.Exchange) -> None:
        """Add an exchange of one of the actors with the safety service (docs/method.md §15)."""
        now, decision, widening = self._bin(), exchange.reply.decision, max(exchange.request.widening, 1.0)
        now["exchanges"] += 1
        now["slowed"] += exchange.request.slow > 0.0
        now.widening = max(now.widening, widening)
        if decision.HasField("score"):
            now["scored"] += 1
            now["beyond"] += not decision.score <= 1.0
            now["beyond_widened"] += not plan_score(decision) <= widening
        if decision.tube_half_width:
            now["tubes"] += 1
            now.half_width += max(decision.tube_half_width)
        if decision.model and len(self._models) < MOST_MODELS:
            self._models.setdefault(decision.model, self.recorded)

    def learner(self, metrics: pb.LearnerMetrics) -> None:
        """Add a learner's metrics; of many messages, evenly spaced ones become points."""
        self._newest = max(self._newest, metrics.weights_version)
        if self._messages % self._stride == 0:
            self._learned.append(tuple(float(getattr(metrics, name)) for name in CURVES))
            if len(self._learned) >= MOST_POINTS:
                self._learned, self._stride = self._learned[::2], 2 * self._stride
        self._messages += 1

    def figures(self) -> Figures:
        """Return the curves. Each row of `bins` ends at the step `until`; None: no (whole) episode ended in the bin."""
        rows, until = [], 0
        for row in self.bins:
            until, steps, episodes = until + row["steps"], row["steps"], row["episodes"]
            if steps:
                rates = {name: row[name] / steps for name in COUNTED.values()}
                ends = {
                    "goals": row["goals"] / episodes if episodes else None,
                    "collisions": row["collisions"],
                    "reward": row.reward / row["whole"] if row["whole"] else None,
                }
                closest = finite(row.closest)
                row_steps = {"until": until, "steps": steps, **rates, "episodes": episodes, **ends, "closest": closest}
                rows.append(row_steps | row.sets())
        return {
            "bin_steps": self.width,
            "bins": rows,
            "models": [{"model": model, "from": step} for model, step in self._models.items()],
            "staleness": summary(self.staleness),
            "last": self._last(),
            "learner": [dict(zip(CURVES, point, strict=True)) for point in self._learned],
        }

    def _last(self) -> Figures:
        """Return the figures of the last episodes; None without an episode."""
        last, steps = list(self.last), sum(episode.steps for episode in self.last)
        rewards = [episode.reward for episode in last if episode.whole]
        return {
            "episodes": len(last),
            "goals": sum(episode.goal for episode in last) / len(last) if last else None,
            "collisions": sum(episode.collision for episode in last),
            "reward": math.fsum(rewards) / len(rewards) if rewards else None,
            "interventions": sum(episode.interventions for episode in last) / steps if steps else None,
        }

    def _bin(self) -> Bin:
        return self._next() if self.bins[-1]["steps"] >= self.width else self.bins[-1]

    def _next(self) -> Bin:
        """Begin a bin; merge neighbours if all bins are used."""
        if len(self.bins) == MOST_BINS:
            for even, odd in zip(self.bins[::2], self.bins[1::2], strict=True):
                even.join(odd)
            self.bins = self.bins[::2]
            self.width *= 2
        self.bins.append(Bin())
        return self.bins[-1]

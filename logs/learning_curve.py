"""How a robot changes while it learns: rates over the steps of all actors, in a bounded number of bins.

When the bins are used up, each two become one that is twice as wide. What is "over training" depends on the order in
which the steps of different actors came in, so this is no part of `Metrics`.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass, fields

from brakeline.logs.episode_stats import Figures
from brakeline.logs.quantiles import QuantileSketch, summary
from brakeline.messaging import brakeline_pb2 as pb

MOST_BINS = 200
FIRST_WIDTH = 50  # steps
LAST = 100  # episodes that the headline is about
MOST_LEARNED = 400  # points of a learner's curves
CURVES = ("steps", "updates", "critic_loss", "actor_loss", "mean_q")  # of them

_ADJUSTED, _FAILSAFE = int(pb.ADJUSTED), int(pb.FAILSAFE)


@dataclass
class Bin:
    """Sums over some steps, and over the episodes that ended in them."""

    steps: int = 0
    adjusted: int = 0
    failsafes: int = 0
    episodes: int = 0
    goals: int = 0
    collisions: int = 0
    reward: float = 0.0  # of these episodes, without the penalty
    closest: float = math.inf  # m

    def join(self, other: Bin) -> None:
        for item in fields(self):
            mine, its = getattr(self, item.name), getattr(other, item.name)
            setattr(self, item.name, min(mine, its) if item.name == "closest" else mine + its)


@dataclass
class Episode:
    """What came of an episode so far."""

    steps: int = 0
    interventions: int = 0
    reward: float = 0.0  # without the penalty
    goal: bool = False
    collision: bool = False


class LearningCurve:
    """Takes the steps of one robot kind in the order in which they came in."""

    def __init__(self) -> None:
        self.width = FIRST_WIDTH
        self.bins: list[Bin] = [Bin()]
        self.staleness = QuantileSketch()  # versions that a step's weights were behind the newest that was known
        self.last: deque[Episode] = deque(maxlen=LAST)
        self._running: dict[str, Episode] = {}
        self._learned: list[tuple[float, ...]] = []  # a point each, as CURVES names them
        self._stride = 1  # of a learner's words that become a point
        self._heard = 0
        self._newest = 0
        self._now = self.bins[0]

    def step(self, step: pb.Step) -> None:
        now = self._now
        if now.steps >= self.width:
            now = self._next()
        now.steps += 1
        kind = step.decision
        if step.fallback or kind == _FAILSAFE:
            now.failsafes += 1
        elif kind == _ADJUSTED:
            now.adjusted += 1
        clearance = step.clearance
        if clearance < now.closest:
            now.closest = clearance
        version = step.weights_version
        if version > self._newest:
            self._newest = version
        self.staleness.add(self._newest - version)
        actor = step.actor
        episode = self._running.get(actor)
        if episode is None or step.step == 0:
            episode = self._running[actor] = Episode()
        episode.reward += step.reward
        episode.steps += 1
        episode.interventions += step.fallback or kind in (_ADJUSTED, _FAILSAFE, int(pb.RECOVERING))
        episode.collision = episode.collision or step.collision
        if step.terminated or step.truncated:
            episode.goal = step.goal
            now.episodes += 1
            now.goals += step.goal
            now.collisions += step.collision
            now.reward += episode.reward
            self.last.append(self._running.pop(actor))

    def learner(self, metrics: pb.LearnerMetrics) -> None:
        """The learner says how far it is; of many such words some are kept, evenly."""
        self._newest = max(self._newest, metrics.weights_version)
        if self._heard % self._stride == 0:
            self._learned.append(tuple(float(getattr(metrics, name)) for name in CURVES))
            if len(self._learned) >= MOST_LEARNED:
                self._learned, self._stride = self._learned[::2], 2 * self._stride
        self._heard += 1

    def figures(self) -> Figures:
        """`bins`: one row each, up to the step `until`; None where no episode ended."""
        rows, until = [], 0
        for row in self.bins:
            until += row.steps
            if row.steps:
                rows.append(
                    {
                        "until": until,
                        "steps": row.steps,
                        "adjusted": row.adjusted / row.steps,
                        "failsafes": row.failsafes / row.steps,
                        "episodes": row.episodes,
                        "goals": row.goals / row.episodes if row.episodes else None,
                        "collisions": row.collisions,
                        "reward": row.reward / row.episodes if row.episodes else None,
                        "closest": row.closest if math.isfinite(row.closest) else None,
                    }
                )
        return {
            "bin_steps": self.width,
            "bins": rows,
            "staleness": summary(self.staleness),
            "last": self._last(),
            "learner": [dict(zip(CURVES, point, strict=True)) for point in self._learned],
        }

    def _last(self) -> Figures:
        """What came of the last episodes that ended; None where there was none."""
        last, steps = list(self.last), sum(episode.steps for episode in self.last)
        return {
            "episodes": len(last),
            "goals": sum(episode.goal for episode in last) / len(last) if last else None,
            "collisions": sum(episode.collision for episode in last),
            "reward": math.fsum(episode.reward for episode in last) / len(last) if last else None,
            "interventions": sum(episode.interventions for episode in last) / steps if steps else None,
        }

    def _next(self) -> Bin:
        """Begin a bin, after making room for it."""
        if len(self.bins) == MOST_BINS:
            for even, odd in zip(self.bins[::2], self.bins[1::2], strict=True):
                even.join(odd)
            self.bins = self.bins[::2]
            self.width *= 2
        self.bins.append(Bin())
        self._now = self.bins[-1]
        return self._now

"""Summarize the steps of a robot: the figures that `evaluate` and `analyse` share.

`evaluate` fills an `EpisodeStats` without a bus; `Metrics` has one for each actor. Parts are merged in the given order,
so that the same steps give the same figures to the last bit.
"""

from __future__ import annotations

import math
from array import array
from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from brakeline.logs.json_values import finite
from brakeline.logs.proportion_intervals import ClusteredProportion, clopper_pearson, poisson
from brakeline.logs.quantiles import QuantileSketch, spread, summary
from brakeline.messaging import brakeline_pb2 as pb

Figures = dict[str, Any]  # named values for JSON

CONTACTS = ("contacts_moving", "contacts_standing", "contacts_robots")  # with moving obstacles and other robots

RUN_INTO = "contacts_standing"  # one episode may have several

ENDS = ("goals", "collisions", *CONTACTS, "timeouts")  # how episodes end

OWN_PROGRAM = "own program"  # the policy in a log of `RecordedClient`

# Fields of `EpisodeStats` that are also figures: sums over the actors.
COUNTS = (
    *(*ENDS, "steps", "interventions", "adjusted", "for_clearance"),
    *("failsafes", "recovering", "fallbacks"),
)

KINDS: dict[int, str] = {
    pb.ALLOWED: "allowed",
    pb.ADJUSTED: "adjusted",
    pb.FAILSAFE: "failsafe",
    pb.RECOVERING: "recovering",
}
_ADJUSTED, _FAILSAFE, _RECOVERING = INTERVENTIONS = int(pb.ADJUSTED), int(pb.FAILSAFE), int(pb.RECOVERING)


def kind_of(step: pb.Step) -> int:
    """Return the kind of a step's decision: a step without a decision in time counts as failsafe."""
    return _FAILSAFE if step.fallback else step.decision


def closest_of(step: pb.Step) -> float:
    """Return the least clearance [m] within a step's period; of an old log, the clearance at the period's end."""
    return step.closest if step.HasField("closest") else step.clearance


@dataclass(slots=True)
class StepSequence:
    """Tells from the numbers of an actor's steps whether a log has all steps of an episode.

    Attributes:
        whole: all steps of the running episode came until now.
    """

    whole: bool = True
    _index: int = 0
    _step: int = -1

    def add(self, step: pb.Step, begins: bool) -> None:
        """Add the actor's next step; `begins`: it is the first one of an episode that is known."""
        index, number = step.index, step.step  # in real time, a period without a step leaves out a number
        follows = index == self._index + 1 if index else number == self._step + 1
        self.whole = number == 0 or (follows and index > 0) if begins else self.whole and follows
        self._index, self._step = index, number


@dataclass
class EpisodeStats:
    """Statistics of one actor's steps."""

    robot: str = ""
    steps: int = 0
    goals: int = 0
    collisions: int = 0  # episodes with a collision with a fixed obstacle
    contacts_moving: int = 0  # episodes in which the robot, in motion, touched a moving obstacle
    contacts_standing: int = 0  # times that an obstacle ran into the standing robot; an episode may have several
    contacts_robots: int = 0  # episodes in which the robot touched another robot
    fleet: int = 0  # robots in the world; 0: a single robot
    broken: int = 0  # times that an obstacle was measured outside its stated motion bounds
    timeouts: int = 0
    interventions: int = 0  # steps whose executed action differs from the proposal
    adjusted: int = 0  # interventions with the closest verified input
    for_clearance: int = 0  # adjusted steps whose proposal was verified, but below the clearance margin
    without_for_clearance: int = 0  # adjusted steps of other methods or old logs, without the field
    failsafes: int = 0  # interventions along the committed plan
    recovering: int = 0  # interventions that leave an area where nothing can be verified
    fallbacks: int = 0  # failsafes without a decision in time
    outside: int = 0  # steps whose true state was outside the stated measurement bound
    compared: int = 0  # steps with a predicted set
    violations: int = 0  # compared steps whose measured state is outside that set
    speed: float = 0.0  # m/s, summed
    max_speed: float = 0.0  # m/s
    closest: float = math.inf  # m, least clearance within the periods
    clearance: QuantileSketch = field(default_factory=QuantileSketch)  # m, from the footprint to the nearest obstacle
    # Per finished episode, without penalties; NaN: a part of the episode is missing.
    returns: array[float] = field(default_factory=lambda: array("d"))
    decision_ms: dict[int, QuantileSketch] = field(default_factory=lambda: {kind: QuantileSketch() for kind in KINDS})
    propose_ms: QuantileSketch = field(default_factory=QuantileSketch)
    intervention_rate: ClusteredProportion = field(default_factory=ClusteredProportion)  # by finished episode
    _sequence: StepSequence = field(default_factory=StepSequence)
    _episode: int | None = None
    _return: float = 0.0
    _collided: bool = False
    _begun_at: tuple[int, int] = (0, 0)  # steps and interventions before this episode

    def step(self, step: pb.Step) -> None:
        """Add the actor's next step. An unfinished episode counts only in the steps and the collisions."""
        episode = step.episode
        begins = episode != self._episode or step.step == 0
        self._sequence.add(step, begins)
        if begins:
            self._episode, self._return, self._collided = episode, 0.0, False
            self._begun_at = self.steps, self.interventions
            self.robot = self.robot or step.robot
            self.fleet = max(self.fleet, step.fleet)
        self.steps += 1
        speed = step.speed
        self.speed += speed
        if speed > self.max_speed:
            self.max_speed = speed
        closest = closest_of(step)
        if closest < self.closest:
            self.closest = closest
        self.clearance.add(step.clearance)
        self._return += step.reward
        self._add_decision(step)
        self._add_failures(step)
        if step.terminated or step.truncated:
            self._end_episode(step)

    def _add_decision(self, step: pb.Step) -> None:
        kind = kind_of(step)
        if step.fallback:
            self.fallbacks += 1
        elif kind in self.decision_ms:
            self.decision_ms[kind].add(step.decide_ms)
        if kind in INTERVENTIONS:
            self.interventions += 1
        if kind == _FAILSAFE:
            self.failsafes += 1
        elif kind == _RECOVERING:
            self.recovering += 1
        elif kind == _ADJUSTED:
            self.adjusted += 1
            if step.HasField("for_clearance"):
                self.for_clearance += step.for_clearance
            else:
                self.without_for_clearance += 1
        if propose_ms := step.propose_ms:
            self.propose_ms.add(propose_ms)

    def _add_failures(self, step: pb.Step) -> None:
        self.outside += step.outside
        self.compared += step.compared
        self.violations += step.compared and not step.contained
        if step.collision and not self._collided:
            self._collided = True
            self.collisions += 1
        self.contacts_moving += step.contact_moving  # a contact ends the episode
        self.contacts_standing += step.contact_standing
        self.contacts_robots += step.contact_robot
        self.broken += step.broken

    def _end_episode(self, step: pb.Step) -> None:
        self.returns.append(self._return if self._sequence.whole else math.nan)
        self.goals += step.goal
        self.timeouts += step.truncated and not step.terminated and not step.cut
        steps, interventions = self._begun_at
        self.intervention_rate.add(self.interventions - interventions, self.steps - steps)
        self._episode = None


def closed_loop(parts: Iterable[EpisodeStats]) -> Figures:
    """Return the figures that `evaluate` and `analyse` share, over the steps of these actors."""
    parts = list(parts)

    def total(name: str) -> int:
        return sum(int(getattr(part, name)) for part in parts)

    steps = total("steps")
    returns = np.concatenate([np.asarray(part.returns) for part in parts]) if parts else np.zeros(0)
    whole = returns[np.isfinite(returns)]
    times = {name: [part.decision_ms[kind] for part in parts] for kind, name in KINDS.items()}
    total_ms = spread(*(part for parts in times.values() for part in parts))
    clearance = summary(*(part.clearance for part in parts))
    figures = {
        "episodes": len(returns),
        **{name: total(name) for name in COUNTS},
        "mean_speed": math.fsum(part.speed for part in parts) / steps if steps else None,
        "max_speed": max(part.max_speed for part in parts) if steps else None,
        "mean_reward": float(whole.mean()) if len(whole) else None,
        "decision_ms": total_ms and total_ms | {kind: spread(*parts) for kind, parts in times.items()},
        "propose_ms": spread(*(part.propose_ms for part in parts)),
        "containment": {"steps": total("compared"), "violations": total("violations")},
        "broken": total("broken"),
        "fleet": max((part.fleet for part in parts), default=0),
        "outside": total("outside"),
        "closest_approach": finite(min((part.closest for part in parts), default=math.inf)),
        "clearance": clearance,
    }
    if total("without_for_clearance"):
        figures["for_clearance"] = None
    return figures | {"intervals": intervals(figures, parts)}


def intervals(figures: Figures, parts: Iterable[EpisodeStats]) -> dict[str, list[float] | None]:
    """Return 95 % intervals: outcomes by episode, containment by step, interventions clustered by episode."""
    episodes, contained = figures["episodes"], figures["containment"]
    rate = ClusteredProportion()
    for part in parts:
        rate.join(part.intervention_rate)
    ends = {name: figures[name] for name in ENDS if name != RUN_INTO}
    by_name = {
        **{name: clopper_pearson(count, max(episodes, count)) for name, count in ends.items()},
        RUN_INTO: poisson(figures[RUN_INTO], episodes),
        "interventions": rate.interval(),
        "violations": clopper_pearson(contained["violations"], contained["steps"]),
    }
    return {name: None if interval is None else list(interval) for name, interval in by_name.items()}

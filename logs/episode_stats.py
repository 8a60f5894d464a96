"""What came of a robot's steps: the figures that `evaluate` and `analyse` share.

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

from brakeline.logs.proportion_intervals import ClusteredProportion, clopper_pearson, poisson
from brakeline.logs.quantiles import QuantileSketch, spread, summary
from brakeline.messaging import brakeline_pb2 as pb

Figures = dict[str, Any]  # what JSON can hold

CONTACTS = ("contacts_moving", "contacts_standing", "contacts_robots")  # not with what stands still

RUN_INTO = "contacts_standing"  # of which an episode may have several

KINDS: dict[int, str] = {
    pb.ALLOWED: "allowed",
    pb.ADJUSTED: "adjusted",
    pb.FAILSAFE: "failsafe",
    pb.RECOVERING: "recovering",
}
_UNKNOWN, _ADJUSTED, _FAILSAFE = int(pb.UNKNOWN), int(pb.ADJUSTED), int(pb.FAILSAFE)
_RECOVERING = int(pb.RECOVERING)


@dataclass
class EpisodeStats:
    """The figures of one actor's steps."""

    robot: str = ""
    steps: int = 0
    goals: int = 0
    collisions: int = 0  # episodes with one
    contacts_moving: int = 0  # episodes in which it touched something that moves, itself moving when that began
    contacts_standing: int = 0  # times that it was run into, standing: several in an episode where people step over it
    contacts_robots: int = 0  # episodes in which it touched another robot of its world
    fleet: int = 0  # robots in its world; 0: it is alone
    broken: int = 0  # times that an obstacle was seen outside of what its bounds allowed
    timeouts: int = 0
    interventions: int = 0  # steps whose action was not the proposed one
    adjusted: int = 0  # of these, steps by the closest input that could be verified
    for_clearance: int = 0  # of the adjusted, steps whose proposals were verified but nearer than the clearance margin
    unsaid: int = 0  # of the adjusted, steps of other methods or of earlier versions, which do not say
    failsafes: int = 0  # of the interventions, steps along the committed plan
    recovering: int = 0  # of the interventions, steps out of where nothing could be verified
    fallbacks: int = 0  # of the failsafes, because no decision came
    outside: int = 0  # steps whose true state was outside the stated bound of the measurement
    compared: int = 0  # steps whose measured state was compared with the predicted set
    violations: int = 0  # of these, not contained
    speed: float = 0.0  # m/s, summed
    max_speed: float = 0.0  # m/s
    clearance: QuantileSketch = field(default_factory=QuantileSketch)  # m, from the footprint to the nearest obstacle
    returns: array[float] = field(default_factory=lambda: array("d"))  # per finished episode, without the penalty
    decision_ms: dict[int, QuantileSketch] = field(default_factory=lambda: {kind: QuantileSketch() for kind in KINDS})
    propose_ms: QuantileSketch = field(default_factory=QuantileSketch)
    shares: ClusteredProportion = field(
        default_factory=ClusteredProportion
    )  # interventions in the steps of each finished episode
    _episode: int | None = None
    _return: float = 0.0
    _collided: bool = False
    _begun_at: tuple[int, int] = (0, 0)  # steps and interventions before this episode

    def step(self, step: pb.Step) -> None:
        """Take the actor's next step. An episode that is left unfinished counts only for its steps and collisions."""
        episode = step.episode
        if episode != self._episode or step.step == 0:
            self._episode, self._return, self._collided = episode, 0.0, False
            self._begun_at = self.steps, self.interventions
            self.robot = self.robot or step.robot
            self.fleet = max(self.fleet, step.fleet)
        self.steps += 1
        speed = step.speed
        self.speed += speed
        if speed > self.max_speed:
            self.max_speed = speed
        self.clearance.add(step.clearance)
        self._return += step.reward
        self._decided(step)
        self._went_wrong(step)
        if step.terminated or step.truncated:
            self._ended(step)

    def _decided(self, step: pb.Step) -> None:
        kind, fallback = step.decision, step.fallback
        if fallback:
            self.fallbacks += 1
        elif kind != _UNKNOWN and kind in self.decision_ms:
            self.decision_ms[kind].add(step.decide_ms)
        if fallback or kind == _FAILSAFE:
            self.failsafes += 1
            self.interventions += 1
        elif kind == _ADJUSTED:
            self.adjusted += 1
            self.interventions += 1
            if step.HasField("for_clearance"):
                self.for_clearance += step.for_clearance
            else:
                self.unsaid += 1
        elif kind == _RECOVERING:
            self.recovering += 1
            self.interventions += 1
        if propose_ms := step.propose_ms:
            self.propose_ms.add(propose_ms)

    def _went_wrong(self, step: pb.Step) -> None:
        if step.outside:
            self.outside += 1
        if step.compared:
            self.compared += 1
            if not step.contained:
                self.violations += 1
        if step.collision and not self._collided:
            self._collided = True
            self.collisions += 1
        self.contacts_moving += step.contact_moving  # a contact ends its episode
        self.contacts_standing += step.contact_standing
        self.contacts_robots += step.contact_robot
        self.broken += step.broken

    def _ended(self, step: pb.Step) -> None:
        self.returns.append(self._return)
        if step.goal:
            self.goals += 1
        if step.truncated and not step.terminated and not step.cut:
            self.timeouts += 1
        steps, interventions = self._begun_at
        self.shares.add(self.interventions - interventions, self.steps - steps)
        self._episode = None


def closed_loop(tallies: Iterable[EpisodeStats]) -> Figures:
    """The figures that `evaluate` and `analyse` share, over the steps of these actors."""
    tallies = list(tallies)

    def total(name: str) -> int:
        return sum(int(getattr(tally, name)) for tally in tallies)

    steps = total("steps")
    returns = np.concatenate([np.asarray(tally.returns) for tally in tallies]) if tallies else np.zeros(0)
    times = {name: [tally.decision_ms[kind] for tally in tallies] for kind, name in KINDS.items()}
    every = spread(*(part for parts in times.values() for part in parts))
    clearance = summary(*(tally.clearance for tally in tallies))
    figures = {
        "episodes": len(returns),
        "goals": total("goals"),
        "collisions": total("collisions"),
        "contacts_moving": total("contacts_moving"),
        "contacts_standing": total("contacts_standing"),
        "contacts_robots": total("contacts_robots"),
        "timeouts": total("timeouts"),
        "steps": steps,
        "interventions": total("interventions"),
        "adjusted": total("adjusted"),
        "for_clearance": None if total("unsaid") else total("for_clearance"),
        "failsafes": total("failsafes"),
        "recovering": total("recovering"),
        "fallbacks": total("fallbacks"),
        "mean_speed": math.fsum(tally.speed for tally in tallies) / steps if steps else None,
        "max_speed": max(tally.max_speed for tally in tallies) if steps else None,
        "mean_reward": float(returns.mean()) if len(returns) else None,
        "decision_ms": every and every | {kind: spread(*parts) for kind, parts in times.items()},
        "propose_ms": spread(*(tally.propose_ms for tally in tallies)),
        "containment": {"steps": total("compared"), "violations": total("violations")},
        "broken": total("broken"),
        "fleet": max((tally.fleet for tally in tallies), default=0),
        "outside": total("outside"),
        "closest_approach": clearance and clearance["min"],
        "clearance": clearance,
    }
    return figures | {"intervals": intervals(figures, tallies)}


def intervals(figures: Figures, tallies: Iterable[EpisodeStats]) -> dict[str, list[float] | None]:
    """95 % intervals of the rates: per episode for its ends, per step for the others (interventions: by episodes)."""
    episodes, contained = figures["episodes"], figures["containment"]
    shares = ClusteredProportion()
    for tally in tallies:
        shares.join(tally.shares)
    ends = {name: figures[name] for name in ("goals", "collisions", *CONTACTS, "timeouts") if name != RUN_INTO}
    found = {
        **{name: clopper_pearson(count, max(episodes, count)) for name, count in ends.items()},
        RUN_INTO: poisson(figures[RUN_INTO], episodes),
        "interventions": shares.interval(),
        "violations": clopper_pearson(contained["violations"], contained["steps"]),
    }
    return {name: None if interval is None else list(interval) for name, interval in found.items()}

"""The figures of a run, kept up to date message by message: the live display, `evaluate` and `analyse` share them.

Sums are kept per actor and joined in the order of the actors' names, so that the same messages give the same figures to
the last bit, however those of different actors were interleaved. `evaluate`, without a bus, fills a `Tally` itself.
"""

from __future__ import annotations

import math
from array import array
from collections import Counter
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from google.protobuf.message import Message

from messaging import brakeline_pb2 as pb
from messaging.topics import RECORDED, Topic

Figures = dict[str, Any]  # what JSON can hold

KINDS = {pb.ALLOWED: "allowed", pb.ADJUSTED: "adjusted", pb.FAILSAFE: "failsafe"}


def numbers() -> array[float]:
    return array("d")


@dataclass
class Tally:
    """The figures of one actor's steps."""

    steps: int = 0
    goals: int = 0
    collisions: int = 0  # episodes with one
    timeouts: int = 0
    interventions: int = 0  # steps whose action was not the proposed one
    failsafes: int = 0  # of these, steps along the committed plan
    fallbacks: int = 0  # of these, because no decision came
    outside: int = 0  # steps whose true state was outside the stated bound of the measurement
    compared: int = 0  # steps whose measured state was compared with the predicted set
    violations: int = 0  # of these, not contained
    speed: float = 0.0  # m/s, summed
    max_speed: float = 0.0  # m/s
    returns: array[float] = field(default_factory=numbers)  # per finished episode: its reward, without the penalty
    decision_ms: dict[str, array[float]] = field(default_factory=lambda: {kind: numbers() for kind in KINDS.values()})
    _episode: int | None = None
    _return: float = 0.0
    _collided: bool = False

    def step(self, step: pb.Step) -> None:
        """Take the actor's next step. An episode that is left unfinished counts only for its steps and collisions."""
        if step.episode != self._episode or step.step == 0:
            self._episode, self._return, self._collided = step.episode, 0.0, False
        self.steps += 1
        self.speed += step.speed
        self.max_speed = max(self.max_speed, step.speed)
        self.outside += step.outside
        self.compared += step.compared
        self.violations += step.compared and not step.contained
        self.collisions += step.collision and not self._collided
        self._collided |= step.collision
        self._return += step.reward
        self._decision(step)
        if step.terminated or step.truncated:
            self.returns.append(self._return)
            self.goals += step.goal
            self.timeouts += step.truncated and not step.terminated
            self._episode = None

    def _decision(self, step: pb.Step) -> None:
        failsafe = step.fallback or step.decision == pb.FAILSAFE
        self.fallbacks += step.fallback
        self.failsafes += failsafe
        self.interventions += failsafe or step.decision == pb.ADJUSTED
        if step.decision in KINDS and not step.fallback:
            self.decision_ms[KINDS[step.decision]].append(step.decide_ms)


@dataclass
class Stream:
    """One publisher's messages at one key: the gaps in their numbers are losses."""

    received: int = 0
    duplicates: int = 0
    published: int = 0  # the most that is known of, by the last number or by its process's Health
    last: int = 0

    @property
    def missing(self) -> int:
        return max(0, self.published - self.received)


@dataclass
class ProcessFigures:
    """What a process last said of itself."""

    starts: int = 0
    run: int = 0
    alive: bool = True  # it has not said goodbye
    figures: dict[str, float] = field(default_factory=dict)
    notes: dict[str, str] = field(default_factory=dict)


class Metrics:
    """Takes messages one by one, in the order in which each publisher sent them; `figures` is what they come to.

    `topics` are those of which it is given every message: of these, what a process says it published and what never
    came is missing.
    """

    def __init__(self, topics: Iterable[Topic] = RECORDED) -> None:
        self.actors: dict[str, Tally] = {}
        self.streams: dict[tuple[str, int], Stream] = {}  # by key and start of the process
        self.learners: dict[str, pb.LearnerMetrics] = {}  # the latest, by robot
        self.processes: dict[str, ProcessFigures] = {}
        self.round_trip_ms = numbers()
        self.failures: Counter[str] = Counter()  # exchanges without a decision, by reason
        self.log_lines: Counter[str] = Counter()  # by level
        self.start, self.end = math.inf, -math.inf  # s since the Unix epoch
        self._roots = {topic.key.split("/", 1)[0] for topic in topics}
        self._takers: dict[type[Message], Callable[[Any], None]] = {
            pb.Step: self._step,
            pb.Exchange: self._exchange,
            pb.LearnerMetrics: self._learner,
            pb.Health: self._health,
            pb.LogLine: self._log_line,
        }

    def add(self, key: str, message: Any) -> None:
        """Take a message that was published at `key`. One that came before is only counted as a duplicate."""
        header: pb.Header = message.header
        stream = self._stream(key, header.run)
        if header.sequence and header.sequence <= stream.last:
            stream.duplicates += 1
            return
        stream.received += 1
        stream.last = header.sequence
        stream.published = max(stream.published, stream.last)
        self.start = min(self.start, header.wall_time * 1e-9)
        self.end = max(self.end, header.wall_time * 1e-9)
        taker = self._takers.get(type(message))
        if taker is not None:
            taker(message)

    def figures(self) -> Figures:
        """All figures; None where nothing was measured."""
        seconds = max(0.0, self.end - self.start)
        figures = closed_loop([self.actors[name] for name in sorted(self.actors)])
        return figures | {
            "seconds": seconds,
            "steps_per_s": figures["steps"] / seconds if seconds > 0.0 else None,
            "actors": {name: closed_loop([self.actors[name]]) for name in sorted(self.actors)},
            "learners": {robot: learner(self.learners[robot]) for robot in sorted(self.learners)},
            "round_trip_ms": spread(self.round_trip_ms),
            "no_decision": dict(sorted(self.failures.items())),
            "topics": self.topics(),
            "processes": {name: vars(self.processes[name]) for name in sorted(self.processes)},
            "log_lines": dict(sorted(self.log_lines.items())),
        }

    def topics(self) -> dict[str, dict[str, int]]:
        """Per key: `messages` received, `missing` ones (gaps in the numbers, or never come) and `duplicates`."""
        totals: dict[str, dict[str, int]] = {}
        for key, _ in sorted(self.streams):
            totals[key] = {"messages": 0, "missing": 0, "duplicates": 0}
        for (key, _), stream in self.streams.items():
            totals[key]["messages"] += stream.received
            totals[key]["missing"] += stream.missing
            totals[key]["duplicates"] += stream.duplicates
        return totals

    def _stream(self, key: str, run: int) -> Stream:
        return self.streams.setdefault((key, run), Stream())

    def _step(self, step: pb.Step) -> None:
        self.actors.setdefault(step.actor, Tally()).step(step)

    def _exchange(self, exchange: pb.Exchange) -> None:
        if exchange.failure:
            self.failures[exchange.failure.split(":", 1)[0]] += 1
        else:
            self.round_trip_ms.append(exchange.round_trip_ms)

    def _learner(self, metrics: pb.LearnerMetrics) -> None:
        self.learners[metrics.robot] = metrics

    def _health(self, health: pb.Health) -> None:
        process = self.processes.setdefault(health.process, ProcessFigures())
        process.starts += health.header.run != process.run
        process.run = health.header.run
        process.alive = not health.last
        process.figures, process.notes = dict(health.figures), dict(health.notes)
        for key, count in health.published.items():
            if count and key.split("/", 1)[0] in self._roots:
                stream = self._stream(key, health.header.run)
                stream.published = max(stream.published, count)

    def _log_line(self, line: pb.LogLine) -> None:
        self.log_lines[line.level] += 1


def closed_loop(tallies: Iterable[Tally]) -> Figures:
    """The figures that `evaluate` and `analyse` share, over the steps of these actors."""
    tallies = list(tallies)

    def total(name: str) -> int:
        return sum(int(getattr(tally, name)) for tally in tallies)

    steps = total("steps")
    returns = np.concatenate([np.asarray(tally.returns) for tally in tallies]) if tallies else np.zeros(0)
    times = {kind: [tally.decision_ms[kind] for tally in tallies] for kind in KINDS.values()}
    every = spread(*(part for parts in times.values() for part in parts))
    return {
        "episodes": len(returns),
        "goals": total("goals"),
        "collisions": total("collisions"),
        "timeouts": total("timeouts"),
        "steps": steps,
        "interventions": total("interventions"),
        "failsafes": total("failsafes"),
        "fallbacks": total("fallbacks"),
        "mean_speed": math.fsum(tally.speed for tally in tallies) / steps if steps else None,
        "max_speed": max(tally.max_speed for tally in tallies) if steps else None,
        "mean_reward": float(returns.mean()) if len(returns) else None,
        "decision_ms": every and every | {kind: spread(*parts) for kind, parts in times.items()},
        "containment": {"steps": total("compared"), "violations": total("violations")},
        "outside": total("outside"),
    }


def spread(*parts: array[float]) -> dict[str, float] | None:
    """Mean, standard deviation, median and 99th percentile of the values; None if there is none."""
    values = np.concatenate([np.asarray(part) for part in parts]) if parts else np.zeros(0)
    if not len(values):
        return None
    p50, p99 = np.percentile(values, (50, 99))
    return {"mean": float(values.mean()), "std": float(values.std()), "p50": float(p50), "p99": float(p99)}


def learner(metrics: pb.LearnerMetrics) -> Figures:
    """A learner's latest figures under the names of the message."""
    names = [field.name for field in metrics.DESCRIPTOR.fields if field.name not in ("header", "robot")]
    return {name: getattr(metrics, name) for name in names}

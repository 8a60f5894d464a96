"""The figures of a run, kept up to date message by message: the live display and `analyse` share them.

Sums are kept per actor and joined in the order of the actors' names, so that the same messages give the same figures to
the last bit, however those of different actors were interleaved.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from functools import partial
from typing import Any, TypeVar

from google.protobuf.message import Message

from brakeline.logs import tube_stats
from brakeline.logs.decision_stats import DecisionStats, joined
from brakeline.logs.episode_stats import KINDS, EpisodeStats, Figures, closed_loop
from brakeline.logs.quantiles import QuantileSketch, spread
from brakeline.logs.recorded_robots import RecordedRobots
from brakeline.logs.tube_stats import TubeStats
from brakeline.messaging import brakeline_pb2 as pb
from brakeline.messaging.topics import HEALTH, RECORDED, STEP, Topic

K = TypeVar("K")
V = TypeVar("V")

__all__ = ["KINDS", "EpisodeStats", "Figures", "Metrics", "closed_loop", "spread"]

MOST_STREAMS = 20_000  # what would be one more is nobody's
MOST_NAMES = 4_000  # of actors, learners, processes; an actor's histograms take 10 kB and more
LEVELS = ("DEBUG", "INFO", "WARNING", "ERROR")
SILENT = HEALTH.stale_after or 3.0  # s without a sign of life after which a process counts as gone


class Crowded(ValueError):
    """More publishers, actors or processes than any run has."""


@dataclass(slots=True)
class PublisherStream:
    """One publisher's messages at one key: the gaps in their numbers are losses."""

    received: int = 0
    duplicates: int = 0
    published: int = 0  # the most that is known of, by the last number or by its process's Health
    last: int = 0
    first_at: int = 0  # ns since the Unix epoch, published
    last_at: int = 0

    @property
    def missing(self) -> int:
        return max(0, self.published - self.received)


@dataclass
class ProcessFigures:
    """What a process last said of itself, and how regularly it spoke."""

    starts: int = 0
    run: int = 0
    alive: bool = True  # it has not said goodbye
    figures: dict[str, float] = field(default_factory=dict)
    notes: dict[str, str] = field(default_factory=dict)
    silences: int = 0  # times that it was not heard of for `SILENT` seconds while it lived
    longest_silence: float = 0.0  # s
    runs: set[int] = field(default_factory=set)
    heard_at: int = 0  # ns since the Unix epoch


class Metrics:
    """Takes messages one by one, in the order in which each publisher sent them; `figures` is what they come to, in
    memory that is bounded whatever they say.

    `topics` are those of which it is given every message: of these, what a process says it published and what never
    came is missing. robots: those that the messages name.
    """

    def __init__(self, topics: Iterable[Topic] = RECORDED, robots: RecordedRobots | None = None) -> None:
        self._robots = robots or RecordedRobots()
        self.actors: dict[str, EpisodeStats] = {}
        self.decisions: dict[str, DecisionStats] = {}  # by actor
        self.plans: dict[str, TubeStats] = {}  # by actor
        self.streams: dict[tuple[str, int], PublisherStream] = {}  # by key and start of the process
        self.learners: dict[str, pb.LearnerMetrics] = {}  # the latest, by robot
        self.processes: dict[str, ProcessFigures] = {}
        self.log_lines: Counter[str] = Counter()  # by level
        self._roots = {topic.key.split("/", 1)[0] for topic in topics}
        self._takers: dict[type[Message], Callable[[Any], None]] = {
            pb.Step: self._step,
            pb.Exchange: self._exchange,
            pb.LearnerMetrics: self._learner,
            pb.Health: self._health,
            pb.LogLine: self._log_line,
        }

    def add(self, key: str, message: Any) -> bool:
        """Take a message that was published at `key`; False: it came before, and is only counted as a duplicate.

        Raises:
            Crowded: it is of somebody who is one too many.
        """
        header: pb.Header = message.header
        sequence, place = header.sequence, (key, header.run)
        stream = self.streams.get(place) or _entered(self.streams, place, PublisherStream)
        if sequence and sequence <= stream.last:
            stream.duplicates += 1
            return False
        stream.received += 1
        stream.last = sequence
        if sequence > stream.published:
            stream.published = sequence
        stream.last_at = header.wall_time
        if not stream.first_at:
            stream.first_at = stream.last_at
        taker = self._takers.get(type(message))
        if taker is not None:
            taker(message)
        return True

    @property
    def failures(self) -> Counter[str]:
        """Exchanges without a decision, by reason."""
        return sum((decisions.failures for decisions in self.decisions.copy().values()), Counter())

    def figures(self) -> Figures:
        """All figures; None where nothing was measured."""
        return together({"": self})

    def seconds(self, topic: Topic | None = None) -> float:
        """How long at least one process was heard of (of the topic: from its first to its last message); a pause before
        a run was resumed does not count."""
        root = "" if topic is None else topic.key.partition("/")[0] + "/"
        streams = {place: stream for place, stream in self.streams.items() if place[0].startswith(root)}
        return covered(self.spans(streams).values())

    def latency(self) -> dict[str, dict[str, QuantileSketch]]:
        """By kind of decision and part of the time, in ms."""
        every = joined([self.decisions[name] for name in sorted(self.decisions)])
        return {KINDS[kind]: parts for kind, parts in every.latency.items()}

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

    @staticmethod
    def spans(streams: dict[tuple[str, int], PublisherStream]) -> dict[int, tuple[int, int]]:
        """When each start of a process was first and last heard of, in ns."""
        spans: dict[int, tuple[int, int]] = {}
        for (_, run), stream in streams.items():
            if stream.received:
                first, last = spans.get(run, (stream.first_at, stream.last_at))
                spans[run] = min(first, stream.first_at), max(last, stream.last_at)
        return spans

    def process(self, name: str) -> Figures:
        """The figures of a process; how it ended is seen from the last message of all."""
        process = self.processes[name]
        spans = self.spans(self.streams)
        seconds = math.fsum((spans[run][1] - spans[run][0]) * 1e-9 for run in process.runs if run in spans)
        messages = sum(stream.received for (_, run), stream in self.streams.items() if run in process.runs)
        latest = max((last for _, last in spans.values()), default=0)
        silent = (latest - process.heard_at) * 1e-9 > SILENT
        return {
            "starts": process.starts,
            "run": process.run,
            "alive": process.alive,
            "ended": "in order" if not process.alive else "without a word" if silent else "lived at the log's end",
            "seconds": seconds,
            "messages": messages,
            "messages_per_s": messages / seconds if seconds > 0.0 else None,
            "silences": process.silences,
            "longest_silence": process.longest_silence,
            "figures": process.figures,
            "notes": process.notes,
        }

    def _stream(self, key: str, run: int) -> PublisherStream:
        return _entered(self.streams, (key, run), PublisherStream)

    def _step(self, step: pb.Step) -> None:
        name = step.actor
        tally = self.actors.get(name) or _entered(self.actors, name, EpisodeStats)
        tally.step(step)

    def _exchange(self, exchange: pb.Exchange) -> None:
        name = exchange.request.actor
        decisions = self.decisions.get(name) or _entered(self.decisions, name, DecisionStats)
        decisions.exchange(exchange)
        (self.plans.get(name) or _entered(self.plans, name, partial(TubeStats, self._robots))).exchange(exchange)

    def _learner(self, metrics: pb.LearnerMetrics) -> None:
        name = metrics.robot
        _entered(self.learners, name, pb.LearnerMetrics)
        self.learners[name] = metrics

    def _health(self, health: pb.Health) -> None:
        process = _entered(self.processes, health.process, ProcessFigures)
        now = health.header.wall_time
        if health.header.run == process.run:
            silence = (now - process.heard_at) * 1e-9
            process.silences += silence > SILENT
            process.longest_silence = max(process.longest_silence, silence)
        else:
            process.starts += 1
        process.run, process.heard_at = health.header.run, now
        if len(process.runs) < MOST_STREAMS:
            process.runs.add(process.run)
        process.alive = not health.last
        process.figures, process.notes = dict(health.figures), dict(health.notes)
        for key, count in health.published.items():
            if count and key.split("/", 1)[0] in self._roots:
                stream = self._stream(key, health.header.run)
                stream.published = max(stream.published, count)

    def _log_line(self, line: pb.LogLine) -> None:
        self.log_lines[line.level if line.level in LEVELS else "other"] += 1


def _entered(table: dict[K, V], name: K, make: Callable[[], V]) -> V:
    """What the table has under the name, made anew if it is the first time. Raises Crowded."""
    if name not in table:
        most = MOST_STREAMS if make is PublisherStream else MOST_NAMES
        if len(table) >= most:
            raise Crowded(f"{name} is one more than {most}")
        table[name] = make()
    return table[name]


def together(runs: Mapping[str, Metrics]) -> Figures:
    """The figures of runs, by the prefix that tells apart the names of their actors, learners and processes.

    Counts and histograms are those of all; each process is seen against its own run, so that who ended with an earlier
    one is not missed.
    """
    actors = {prefix + name: tally for prefix, run in runs.items() for name, tally in run.actors.items()}
    names = sorted(actors)
    figures = closed_loop([actors[name] for name in names])
    robots = sorted({tally.robot for tally in actors.values()})
    by_robot = {robot: [actors[name] for name in names if actors[name].robot == robot] for robot in robots}
    decisions = {prefix + name: part for prefix, run in runs.items() for name, part in run.decisions.items()}
    learners = {prefix + robot: last for prefix, run in runs.items() for robot, last in run.learners.items()}
    seconds = covered(span for run in runs.values() for span in run.spans(run.streams).values())
    return figures | {
        "seconds": seconds,
        "steps_per_s": figures["steps"] / seconds if seconds > 0.0 else None,
        "driven_s": math.fsum(run.seconds(STEP) for run in runs.values()),
        "robots": {robot: closed_loop(tallies) for robot, tallies in by_robot.items()},
        "actors": {name: closed_loop([actors[name]]) for name in names},
        "learners": {robot: learner(learners[robot]) for robot in sorted(learners)},
        **joined([decisions[name] for name in sorted(decisions)]).figures(),
        "plans": tube_stats.figures(part for run in runs.values() for part in run.plans.copy().values()),
        "topics": _summed([run.topics() for run in runs.values()]),
        "processes": {
            prefix + name: run.process(name) for prefix, run in runs.items() for name in sorted(run.processes)
        },
        "log_lines": dict(sorted(sum((run.log_lines for run in runs.values()), Counter[str]()).items())),
    }


def _summed(parts: Iterable[dict[str, dict[str, int]]]) -> dict[str, dict[str, int]]:
    """Counts by key and name, added up."""
    totals: dict[str, dict[str, int]] = {}
    for part in parts:
        for key, counts in part.items():
            known = totals.setdefault(key, dict.fromkeys(counts, 0))
            for name, count in counts.items():
                known[name] += count
    return dict(sorted(totals.items()))


def covered(spans: Iterable[tuple[int, int]]) -> float:
    """Seconds in the union of spans of ns."""
    total, end = 0, 0
    for first, last in sorted(spans):
        total += max(0, last - max(first, end))
        end = max(end, last)
    return total * 1e-9


def learner(metrics: pb.LearnerMetrics) -> Figures:
    """A learner's latest figures under the names of the message."""
    names = [field.name for field in metrics.DESCRIPTOR.fields if field.name not in ("header", "robot")]
    return {name: getattr(metrics, name) for name in names}

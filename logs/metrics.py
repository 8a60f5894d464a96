"""Compute the figures of a run message by message, for the live display and for `analyse`.

Each actor has sums of its own, which are merged in the order of the actors' names. So the same messages give the same
figures to the last bit, however the messages of different actors are interleaved.
"""

from __future__ import annotations

import math
from collections import Counter, defaultdict
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from functools import partial
from operator import itemgetter
from typing import Any, TypeVar

from google.protobuf.message import Message

from brakeline.errors import Implausible
from brakeline.logs import tube_stats
from brakeline.logs.decision_stats import DecisionStats, merge_decisions
from brakeline.logs.episode_stats import KINDS, EpisodeStats, Figures, closed_loop
from brakeline.logs.quantiles import QuantileSketch
from brakeline.logs.recorded_robots import RecordedRobots
from brakeline.logs.step_admission import StepAdmission
from brakeline.logs.tube_stats import TubeStats
from brakeline.messaging import brakeline_pb2 as pb
from brakeline.messaging.bus.identity import identity_of
from brakeline.messaging.topics import HEALTH, LOGGED, RECORDED, STEP, Topic, topic_of

K = TypeVar("K")
V = TypeVar("V")

MOST_STREAMS = 20_000  # keys and process starts; a message beyond them is rejected
MOST_STREAMS_OF_ONE = 5_000  # of one identity, so that it cannot take the place of the others
MOST_NAMES = 4_000  # actors, learners or processes; the sketches of one actor take 10 kB and more
MOST_NAMES_OF_ONE = 1_000  # of one identity
LEVELS = ("DEBUG", "INFO", "WARNING", "ERROR")
SILENT = HEALTH.stale_after or 3.0  # s without a Health message after which a process counts as silent


@dataclass(slots=True)
class PublisherStream:
    """Counts of one publisher's messages at one key; gaps in the sequence numbers are losses."""

    received: int = 0
    duplicates: int = 0
    published: int = 0  # largest count known from a sequence number or from the process's Health
    last: int = 0
    first_at: int = 0  # ns, of receipt
    last_at: int = 0

    @property
    def missing(self) -> int:
        return max(0, self.published - self.received)


@dataclass
class ProcessFigures:
    """The latest Health message of a process, and the gaps between its messages.

    Attributes:
        alive: the process has not announced its end.
        silences: how often no Health message came for `SILENT` seconds.
        longest_silence: s.
        runs: the starts of the process.
        last_health_at: ns, of receipt.
    """

    starts: int = 0
    run: int = 0
    alive: bool = True
    figures: dict[str, float] = field(default_factory=dict)
    notes: dict[str, str] = field(default_factory=dict)
    silences: int = 0
    longest_silence: float = 0.0
    runs: set[int] = field(default_factory=set)
    last_health_at: int = 0


class Metrics:
    """Computes figures from messages in bounded memory. Add each publisher's messages in their order.

    Attributes:
        actors, decisions, plans: statistics by actor.
        streams: counts by key and start of the process.
        learners: the latest metrics by robot.
        processes: by name.
        log_lines: counts by level.
        admission: decides which steps count.
        fed: number of steps that a feeder published from logs, by key and start of the process.
        late: the steps that count since the last message of a learner, because it permitted them.
    """

    def __init__(self, robots: RecordedRobots | None = None) -> None:
        """Create empty statistics; robots: those that messages name."""
        self._robots = robots or RecordedRobots()
        self.actors: dict[str, EpisodeStats] = {}
        self.decisions: dict[str, DecisionStats] = {}
        self.plans: dict[str, TubeStats] = {}
        self.streams: dict[tuple[str, int], PublisherStream] = {}
        self._streams_of: Counter[str] = Counter()  # by identity
        self.learners: dict[str, pb.LearnerMetrics] = {}
        self.processes: dict[str, ProcessFigures] = {}
        self.log_lines: Counter[str] = Counter()
        self.admission = StepAdmission()
        self.fed: dict[tuple[str, int], int] = {}
        self.late: list[pb.Step] = []
        self._now = 0  # ns, when the message in hand was received
        self._tube_stats = partial(TubeStats, self._robots)
        self._handlers: dict[type[Message], Callable[[Any], None]] = {
            pb.Step: self._step,
            pb.Exchange: self._exchange,
            pb.LearnerMetrics: self._add_learner,
            pb.Health: self._health,
            pb.LogLine: self._log_line,
        }

    def add(self, key: str, message: Any, received: int | None = None) -> bool:
        """Add a message that was published at `key`; return False for one that is only counted: repeated, or refused.

        received: time of receipt on a clock without jumps [ns]. Defaults to the time of publication.

        Raises:
            Implausible: the message is from a new publisher, actor or process, and there are too many.
        """
        header: pb.Header = message.header
        sequence, place = header.sequence, (key, header.run)
        stream = self.streams.get(place) or self._new_stream(place)
        if sequence and sequence <= stream.last:
            stream.duplicates += 1
            return False
        stream.received += 1
        stream.last = sequence
        if sequence > stream.published:
            stream.published = sequence
        self._now = stream.last_at = header.wall_time if received is None else received
        if not stream.first_at:
            stream.first_at = stream.last_at
        if isinstance(message, pb.Step) and not self.admission.admit(message):
            return False
        handler = self._handlers.get(type(message))
        if handler is not None:
            handler(message)
        return True

    def figures(self) -> Figures:
        """Return all figures; None for what was not measured."""
        return merge_runs({"": self})

    def seconds(self, topic: Topic | None = None) -> float:
        """Return for how long at least one process published messages [s], without the pause before a resumption.

        Args:
            topic: count only the messages of this topic.
        """
        streams = {place: s for place, s in self.streams.items() if topic is None or topic_of(place[0]) is topic}
        return covered(self.spans(streams).values())

    def latency(self) -> dict[str, dict[str, QuantileSketch]]:
        """Return the latency [ms] by kind of decision and by part."""
        total = merge_decisions([self.decisions[name] for name in sorted(self.decisions)])
        return {KINDS[kind]: parts for kind, parts in total.latency.items()}

    def topics(self) -> dict[str, dict[str, int]]:
        """Return the counts of received `messages`, `missing` messages and `duplicates`, by key."""
        return topics_of([self])

    def fed_to(self, robot: str) -> int:
        """Return how many steps of a robot kind a feeder published from other logs. They are not in this log."""
        return sum(count for (key, _), count in self.fed.items() if key.split("/")[1:2] == [robot])

    @staticmethod
    def spans(streams: dict[tuple[str, int], PublisherStream]) -> dict[int, tuple[int, int]]:
        """Return the times of the first and the last message of each start of a process, ns."""
        spans: dict[int, tuple[int, int]] = {}
        for (_, run), stream in streams.items():
            if stream.received:
                first, last = spans.get(run, (stream.first_at, stream.last_at))
                spans[run] = min(first, stream.first_at), max(last, stream.last_at)
        return spans

    def process(self, name: str) -> Figures:
        """Return the figures of a process. It counts as silent relative to the last message of all processes."""
        process = self.processes[name]
        spans = self.spans(self.streams)
        seconds = math.fsum((spans[run][1] - spans[run][0]) * 1e-9 for run in process.runs if run in spans)
        messages = sum(stream.received for (_, run), stream in self.streams.items() if run in process.runs)
        latest = max((last for _, last in spans.values()), default=0)
        silent = (latest - process.last_health_at) * 1e-9 > SILENT
        return {
            **{name: getattr(process, name) for name in ("starts", "run", "alive")},
            "ended": "in order" if not process.alive else "silently" if silent else "alive at the end of the log",
            "seconds": seconds,
            "messages": messages,
            "messages_per_s": messages / seconds if seconds > 0.0 else None,
            **{name: getattr(process, name) for name in ("silences", "longest_silence", "figures", "notes")},
        }

    def _step(self, step: pb.Step) -> None:
        _get_or_create(self.actors, step.actor, EpisodeStats).step(step)
        if (step.terminated or step.truncated) and step.actor in self.plans:
            self.plans[step.actor].last_step(step)

    def _exchange(self, exchange: pb.Exchange) -> None:
        name = exchange.request.actor
        _get_or_create(self.decisions, name, DecisionStats).exchange(exchange)
        _get_or_create(self.plans, name, self._tube_stats).exchange(exchange)

    def _add_learner(self, metrics: pb.LearnerMetrics) -> None:
        _get_or_create(self.learners, metrics.robot, pb.LearnerMetrics)
        self.learners[metrics.robot] = metrics
        self.late = self.admission.learner(metrics)
        for step in self.late:
            self._step(step)

    def _health(self, health: pb.Health) -> None:
        process = _get_or_create(self.processes, health.process, ProcessFigures)
        now = self._now
        if health.header.run == process.run:
            silence = (now - process.last_health_at) * 1e-9
            process.silences += silence > SILENT
            process.longest_silence = max(process.longest_silence, silence)
        else:
            process.starts += health.header.run not in process.runs  # two processes with one name take turns
        process.run, process.last_health_at = health.header.run, now
        if len(process.runs) < MOST_STREAMS:
            process.runs.add(process.run)
        process.alive = not health.last
        process.figures, process.notes = dict(health.figures), dict(health.notes)
        for key, count in health.published.items():
            place = key, health.header.run
            if topic_of(key) is LOGGED and (place in self.fed or len(self.fed) < MOST_STREAMS):
                self.fed[place] = max(self.fed.get(place, 0), count)
            if count and topic_of(key) in RECORDED:  # a message of these that was not added is missing
                stream = self.streams.get(place) or self._new_stream(place)
                stream.published = max(stream.published, count)

    def _new_stream(self, place: tuple[str, int]) -> PublisherStream:
        """Return the counts of a new publisher. Raises Implausible."""
        sender = identity_of(place[0].rpartition("/")[2])
        if self._streams_of[sender] >= MOST_STREAMS_OF_ONE:
            raise Implausible(f"{place[0]} is rejected: {sender} has {MOST_STREAMS_OF_ONE} keys and starts already")
        stream = _get_or_create(self.streams, place, PublisherStream)
        self._streams_of[sender] += 1
        return stream

    def _log_line(self, line: pb.LogLine) -> None:
        self.log_lines[line.level if line.level in LEVELS else "other"] += 1


def _get_or_create(table: dict[K, V], name: K, make: Callable[[], V]) -> V:
    """Return the entry of a name; create it for a new name. Raises Implausible."""
    if name not in table:
        most = MOST_STREAMS if make is PublisherStream else MOST_NAMES
        if len(table) >= most:
            raise Implausible(f"{name} is rejected: there are already {most}")
        if isinstance(name, str):
            identity = identity_of(name)
            if sum(identity_of(str(other)) == identity for other in table) >= MOST_NAMES_OF_ONE:
                raise Implausible(f"{name} is rejected: {identity} has {MOST_NAMES_OF_ONE} names already")
        table[name] = make()
    return table[name]


def merge_runs(runs: Mapping[str, Metrics]) -> Figures:
    """Merge the figures of runs.

    Args:
        runs: by the prefix that distinguishes the names of their actors, learners and processes.
    """

    def by_name(table: str) -> dict[str, Any]:
        parts = ((prefix + name, part) for prefix, run in runs.items() for name, part in getattr(run, table).items())
        return dict(sorted(parts, key=itemgetter(0)))

    actors = by_name("actors")
    figures = closed_loop(actors.values())
    robots: defaultdict[str, list[EpisodeStats]] = defaultdict(list)
    for stats in actors.values():
        robots[stats.robot].append(stats)
    seconds = covered(span for run in runs.values() for span in run.spans(run.streams).values())
    return figures | {
        "seconds": seconds,
        "steps_per_s": figures["steps"] / seconds if seconds > 0.0 else None,
        "refused": sum(run.admission.refused for run in runs.values()),
        "driven_s": math.fsum(run.seconds(STEP) for run in runs.values()),
        "robots": {robot: closed_loop(robots[robot]) for robot in sorted(robots)},
        "actors": {name: closed_loop([stats]) for name, stats in actors.items()},
        "learners": {robot: learner(metrics) for robot, metrics in by_name("learners").items()},
        **merge_decisions(by_name("decisions").values()).figures(),
        "plans": tube_stats.figures(part for run in runs.values() for part in run.plans.copy().values()),
        "topics": topics_of(runs.values()),
        "processes": {
            prefix + name: run.process(name) for prefix, run in runs.items() for name in sorted(run.processes)
        },
        "log_lines": dict(sorted(sum((run.log_lines for run in runs.values()), Counter[str]()).items())),
    }


def topics_of(runs: Iterable[Metrics]) -> dict[str, dict[str, int]]:
    """Sum the counts of the messages of several runs, by key."""
    totals: dict[str, dict[str, int]] = {}
    for run in runs:
        for (key, _), stream in run.streams.items():
            counts = totals.setdefault(key, {"messages": 0, "missing": 0, "duplicates": 0})
            counts["messages"] += stream.received
            counts["missing"] += stream.missing
            counts["duplicates"] += stream.duplicates
    return dict(sorted(totals.items()))


def covered(spans: Iterable[tuple[int, int]]) -> float:
    """Return the length of the union of intervals [ns], in s."""
    total, end = 0, 0
    for first, last in sorted(spans):
        total += max(0, last - max(first, end))
        end = max(end, last)
    return total * 1e-9


def learner(metrics: pb.LearnerMetrics) -> Figures:
    """Return a learner's latest metrics by the names of the message's fields."""
    names = [field.name for field in metrics.DESCRIPTOR.fields if field.name not in ("header", "robot", "limit")]
    return {name: getattr(metrics, name) for name in names}

"""Analyse logs in one pass from front to back, in memory that does not grow with the log."""

from __future__ import annotations

import contextlib
from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

from brakeline.logs.driving_stats import DrivingStats
from brakeline.logs.episode_sampler import SKETCHES, ActorBuffer, EpisodeSampler
from brakeline.logs.episode_stats import ENDS, OWN_PROGRAM, Figures, closed_loop
from brakeline.logs.intervention_map import InterventionMap
from brakeline.logs.learning_curve import LearningCurve
from brakeline.logs.mcap_container import LogChannel
from brakeline.logs.metrics import Metrics, merge_runs
from brakeline.logs.process_timeline import ProcessTimeline
from brakeline.logs.reader import Log, Paths, by_run, find, without_copies
from brakeline.logs.run_figures import unlogged_messages
from brakeline.logs.run_groups import GroupedRun, compare_groups, differences
from brakeline.messaging.rejected_messages import RejectedMessages
from brakeline.messaging.structured_text import parse_json
from brakeline.messaging.topics import EPISODE, EXCHANGE, HEALTH, LEARNER, LOG, STEP

SETUP = ("method", "certificate", "policy", "arena", "perception", "seed")


@dataclass
class AnalysisOptions:
    """What an analysis computes besides the figures.

    Attributes:
        pictures: the data that the report draws.
        episode: number of an episode to list step by step.
        actor: only this actor's episode; None: every actor's.
        sketches: most episodes of each robot kind that the pictures have in short.
    """

    pictures: bool = False
    episode: int | None = None
    actor: str | None = None
    sketches: int = SKETCHES


class RunAnalysis:
    """The analysis of the log of one run."""

    def __init__(self, label: str, log: Log, options: AnalysisOptions | None = None, prefix: str = "") -> None:
        """Read the log.

        prefix: for the names of actors, to distinguish runs.
        """
        self.label, self.log, self.prefix = label, log, prefix
        self.options = options or AnalysisOptions()
        self.metrics = Metrics(robots=log.robots)
        self.training: defaultdict[str, LearningCurve] = defaultdict(LearningCurve)  # by robot kind
        self.outcomes_stated = False
        self.driving = DrivingStats(log.robots, log.metadata)
        self.intervention_maps: dict[str, InterventionMap] = {}
        self.samplers: dict[str, EpisodeSampler] = {}
        self.timeline = ProcessTimeline()
        self._received = 0  # when the recorder received the message in hand, without jumps of its clock [ns]
        self._buffers: dict[LogChannel, tuple[EpisodeSampler, ActorBuffer]] = {}
        self._read(log)
        self.outcomes_stated |= log.metadata.get("run", {}).get("policy") != OWN_PROGRAM
        for sampler in self.samplers.values():
            sampler.close()
        self._buffers.clear()

    def figures(self) -> Figures:
        """Return all figures of the run."""
        return LogAnalysis([self]).figures()

    def pictures(self) -> Figures:
        """Return what the report draws besides the figures."""
        decisions = self.metrics.latency()
        return {
            "latency": {
                kind: {part: values.bars() for part, values in parts.items()} for kind, parts in decisions.items()
            },
            "places": {robot: self.intervention_maps[robot].figures() for robot in sorted(self.intervention_maps)},
            "galleries": {robot: self.samplers[robot].figures() for robot in sorted(self.samplers)},
            "timeline": self.timeline.figures(),
        }

    def _read(self, log: Log) -> None:
        """Read all messages in one loop."""
        handlers: dict[str, Callable[[LogChannel, Any], None]] = {
            STEP.name: self._step,
            EXCHANGE.name: self._exchange,
            LEARNER.name: lambda _, metrics: self._learner(metrics),
        }
        if self.options.pictures or self.options.episode is not None:
            handlers |= {
                STEP.name: self._drawn_step,
                EXCHANGE.name: self._drawn_exchange,
                EPISODE.name: lambda channel, episode: self._buffer(channel)[1].about.append(episode),
                HEALTH.name: lambda _, health: self.timeline.health(health, self._received),
                LOG.name: lambda _, line: self.timeline.line(line, self._received),
            }
        rejected, add = RejectedMessages(), self.metrics.add
        for channel, message, log_time, _ in log.decoded():
            try:
                self._received = log.clock.at(log_time)
                if add(channel.key, message, self._received) and (handle := handlers.get(channel.topic)) is not None:
                    handle(channel, message)
            except Exception as error:  # reject one message and go on
                log.malformed += 1
                rejected.reject(channel.key, error)

    def _learner(self, metrics: Any) -> None:
        """Add a learner's message, and the steps after a gap of the log that it permits. Episodes drawn lack these."""
        self.training[metrics.robot].learner(metrics)
        for step in self.metrics.late:
            self.training[metrics.robot].step(step)

    def _step(self, channel: LogChannel, step: Any) -> None:
        self.training[channel.robot].step(step)
        # A log from before the field states what it has.
        self.outcomes_stated |= step.outcome_stated or step.goal or step.collision or step.reward != 0.0

    def _drawn_step(self, channel: LogChannel, step: Any) -> None:
        self._step(channel, step)
        sampler, buffer = self._buffer(channel)
        sampler.step(buffer, step)
        self.timeline.step(self._received)

    def _exchange(self, channel: LogChannel, exchange: Any) -> None:
        self.training[channel.robot].exchange(exchange)
        self.driving.exchange(exchange)

    def _drawn_exchange(self, channel: LogChannel, exchange: Any) -> None:
        robot = channel.robot
        self._exchange(channel, exchange)
        if robot not in self.intervention_maps:
            self.intervention_maps[robot] = InterventionMap(self.log.robots.named(robot))
        self.intervention_maps[robot].exchange(exchange)
        sampler, buffer = self._buffer(channel)
        sampler.exchange(buffer, exchange)

    def _buffer(self, channel: LogChannel) -> tuple[EpisodeSampler, ActorBuffer]:
        """Return the sampler of the channel's robot kind, and the buffer of its actor."""
        if channel not in self._buffers:
            if channel.robot not in self.samplers:
                robot, options = self.log.robots.named(channel.robot), self.options
                wanted = options.episode, options.actor
                self.samplers[channel.robot] = EpisodeSampler(robot, self.prefix, *wanted, options.sketches)
            sampler = self.samplers[channel.robot]
            self._buffers[channel] = sampler, sampler.source(channel.actor)
        return self._buffers[channel]

    def learning(self, robot: str) -> Figures:
        """Return the learning curves of a kind of robot, without outcomes if none is stated."""
        curves = self.training[robot].figures()
        return curves if self.outcomes_stated else without_outcomes(curves)

    def about(self) -> Figures:
        """Return one row about the run: configuration, figures, missing messages."""
        metrics, log, topics = self.metrics, self.log, self.metrics.topics().values()
        about = log.metadata.get("run", {})
        setup: Figures = {name: about.get(name) for name in SETUP}
        if (conditions := log.metadata.get("conditions")) is not None:
            setup["perception"] = perception_in(conditions)
        if setup["seed"] is not None and setup["seed"].lstrip("-").isdigit():
            setup["seed"] = int(setup["seed"])
        figures = closed_loop([metrics.actors[name] for name in sorted(metrics.actors)])
        return {
            **mark_outcomes(setup | figures, self.outcomes_stated),
            "seconds": metrics.seconds(),
            **{name: sum(topic[name] for topic in topics) for name in ("messages", "missing", "duplicates")},
            "files": len(log.paths),
            "cuts": self.damage(),
            "metadata": _metadata(log),
        }

    def damage(self) -> list[str]:
        """Return what the log lacks, one line each: damage, and steps that a learner had and nobody recorded.

        A count of published messages would miss the latter if an actor ended while no recorder ran. So it would miss
        the last messages of a run, which the run itself has counted.
        """
        return [*cuts_in(self.log), *self._unrecorded_steps(), *self._last_messages()]

    def _unrecorded_steps(self) -> Iterator[str]:
        for robot, metrics in self.metrics.learners.items():
            known = self.training[robot].recorded + self.metrics.fed_to(robot)
            if (lost := metrics.steps - known) > 0:
                yield f"{lost} of the {metrics.steps} steps that the learner of {robot} had are not in the log"

    def _last_messages(self) -> Iterator[str]:
        known = sum(topic["missing"] for topic in self.metrics.topics().values())
        if self.log.paths and (lost := unlogged_messages(self.log.paths[0])) > known:
            yield f"{lost} messages that the run published are not in the log; only {known} of them leave a gap in it"


def cuts_in(log: Log) -> list[str]:
    """Return the damage of a log that has been read, one line each."""
    jumps = [f"the recorder's clock jumped by {jump:+.0f} s: the figures leave that out" for jump in log.clock.jumps]
    return [*(str(cut) for cut in log.cuts), *jumps]


def mark_outcomes(figures: Figures, stated: bool) -> Figures:
    """Return figures with `outcomes_stated`: whether the log says how its episodes ended.

    A program of your own states outcomes and rewards with `record_outcome` and `reset`. If it states none at all, their
    counts are zero because nobody counted, so they have no intervals.
    """
    nothing = {} if stated else {"intervals": figures["intervals"] | dict.fromkeys(ENDS)}
    return figures | nothing | {"outcomes_stated": stated}


def without_outcomes(training: Figures) -> Figures:
    """Return learning curves without goals, collisions and rewards, which nobody stated."""
    nothing = dict.fromkeys(("goals", "collisions", "reward"))
    bins = [row | dict.fromkeys(("goals", "reward")) for row in training["bins"]]
    return training | {"bins": bins, "last": training["last"] | nothing}


def perception_in(conditions: Mapping[str, str]) -> str:
    """Return the source of free space in a run: "map", "scan" ..., also with tracks."""
    kind = conditions.get("perception", "map")
    return f"{kind} with tracks" if conditions.get("tracks") == "True" else kind


class LogAnalysis:
    """The analyses of several runs. Counts are summed; curves and processes stay separate."""

    def __init__(self, parts: Sequence[RunAnalysis]) -> None:
        self.parts = parts

    def figures(self) -> Figures:
        """Return all figures; `runs` has one row for each run.

        With several runs, the label of the run is the prefix of actors, learners, processes and of the robot kinds in
        `training`. Then there are also the figures of `compare_groups`, and `differences`: the settings in which the
        runs differ.
        """
        rows = {part.label: part.about() for part in self.parts}
        logs = [part.log for part in self.parts]
        episode = next((part.options.episode for part in self.parts), None)
        samplers = [part.samplers[robot] for part in self.parts for robot in sorted(part.samplers)]
        details = [picture for sampler in samplers for picture in sampler.requested_episodes]
        prefixes = [part.prefix if len(self.parts) > 1 else "" for part in self.parts]
        merged = merge_runs({prefix: part.metrics for prefix, part in zip(prefixes, self.parts, strict=True)})
        stated = any(part.outcomes_stated for part in self.parts)
        return {
            **mark_outcomes(
                _common([{name: run[name] for name in SETUP} for run in rows.values()], SETUP) | merged, stated
            ),
            "training": {
                prefix + robot: part.learning(robot)
                for prefix, part in zip(prefixes, self.parts, strict=True)
                for robot in sorted(part.training)
            },
            "driving": {
                prefix + robot: kinds
                for prefix, part in zip(prefixes, self.parts, strict=True)
                for robot, kinds in part.driving.figures().items()
            },
            "runs": rows,
            "metadata": _common([run["metadata"] for run in rows.values()]),
            "log": [str(path) for log in logs for path in log.paths],
            "segments": [_segment(segment) for log in logs for segment in log.segments],
            "cuts": [line for part in self.parts for line in part.damage()],
            "malformed": sum(log.malformed for log in logs),
            **({} if episode is None else {"episode": episode, "episode_detail": details}),
            **(self._comparison(rows) if len(self.parts) > 1 else {}),
        }

    def _comparison(self, rows: Mapping[str, Figures]) -> Figures:
        """Return what several runs have in common, and in what they differ. rows: by run."""
        settings = {
            label: {name: row[name] for name in SETUP} | (given if isinstance(given, dict) else {})
            for label, row in rows.items()
            for given in (row["metadata"].get("configuration"),)
        }
        runs = [
            GroupedRun(part.label, robot, settings[part.label], part.training[robot].figures())
            for part in self.parts
            for robot in sorted(part.training)
        ]
        return {**compare_groups(runs), "differences": differences(settings)}

    def by_label(self) -> dict[str, tuple[Figures, Figures]]:
        """Return figures and pictures of each run, by its label."""
        return {part.label: (part.figures(), part.pictures()) for part in self.parts}


def analyse_runs(paths: Paths, options: AnalysisOptions | None = None) -> LogAnalysis:
    """Analyse the logs at `paths`, run by run. The runs share the sketches, so that their page does not become large.

    Raises:
        LogError: a path has no log, or a file is not an MCAP file.
    """
    runs, options = by_run(without_copies(find(paths))), options or AnalysisOptions()
    several = len(runs) > 1
    options = replace(options, sketches=options.sketches // max(1, len(runs)))
    return LogAnalysis(
        [RunAnalysis(label, Log(files), options, f"{label}/" if several else "") for label, files in runs.items()]
    )


def _metadata(log: Log) -> Figures:
    """Return the log's metadata without the legend `brakeline`; the configuration is parsed."""
    metadata: Figures = {name: dict(values) for name, values in log.metadata.items() if name != "brakeline"}
    if "json" in metadata.get("configuration", {}):
        with contextlib.suppress(ValueError):  # a configuration that is not JSON stays a string
            metadata["configuration"] = parse_json(metadata["configuration"]["json"])
    return metadata


def _common(all_: list[Figures], names: tuple[str, ...] | None = None) -> Figures:
    """Return the values that all share; with `names`, also None for each name whose values differ."""
    first, rest = (all_[0], all_[1:]) if all_ else ({}, [])
    same = {name: value for name, value in first.items() if all(other.get(name) == value for other in rest)}
    return same if names is None else {name: same.get(name) for name in names}


def _segment(segment: Any) -> Figures:
    return {
        "path": str(segment.path),
        "bytes": segment.size,
        "messages": segment.messages,
        "start": segment.start * 1e-9 if segment.messages else None,
        "end": segment.end * 1e-9 if segment.messages else None,
        "recording": segment.recording,
    }

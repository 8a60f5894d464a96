"""Reads logs once, front to back, and gives all that can be said of them, in memory that does not grow with them."""

from __future__ import annotations

import contextlib
import json
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from brakeline.logs.episode_sampler import ActorBuffer, EpisodeSampler
from brakeline.logs.episode_stats import Figures
from brakeline.logs.intervention_map import InterventionMap
from brakeline.logs.learning_curve import LearningCurve
from brakeline.logs.mcap_container import LogChannel
from brakeline.logs.metrics import Metrics, closed_loop, together
from brakeline.logs.process_timeline import ProcessTimeline
from brakeline.logs.reader import Log, Paths, by_run, find
from brakeline.messaging.rejected_messages import RejectedMessages
from brakeline.messaging.topics import EPISODE, EXCHANGE, HEALTH, LEARNER, LOG, STEP

SETUP = ("method", "certificate", "policy", "arena", "perception", "seed")


@dataclass
class AnalysisOptions:
    """What is wanted besides the figures."""

    pictures: bool = False  # what the report draws
    episode: int | None = None  # this one in detail ...
    actor: str | None = None  # ... of this actor; None: of all


class RunAnalysis:
    """Takes the log of one run; `figures` and `pictures` are what it comes to."""

    def __init__(self, label: str, log: Log, look: AnalysisOptions | None = None, prefix: str = "") -> None:
        """`prefix` goes before the names of actors in episodes: it tells runs apart."""
        self.label, self.log, self.prefix = label, log, prefix
        self.look = look or AnalysisOptions()
        self.metrics = Metrics(robots=log.robots)
        self.training: dict[str, LearningCurve] = {}  # by robot kind
        self.places: dict[str, InterventionMap] = {}
        self.galleries: dict[str, EpisodeSampler] = {}
        self.timeline = ProcessTimeline()
        self._drawn: dict[LogChannel, tuple[InterventionMap, EpisodeSampler, ActorBuffer]] = {}
        self._kept: dict[LogChannel, deque[Any]] = {}
        self._rejected = RejectedMessages()
        self._take(log)
        for gallery in self.galleries.values():
            gallery.close()
        self._drawn.clear()
        self._kept.clear()

    def figures(self) -> Figures:
        """All figures of the run."""
        return LogAnalysis([self]).figures()

    def pictures(self) -> Figures:
        """What the report draws besides the figures."""
        decisions = self.metrics.latency()
        return {
            "latency": {
                kind: {part: values.bars() for part, values in parts.items()} for kind, parts in decisions.items()
            },
            "places": {robot: self.places[robot].figures() for robot in sorted(self.places)},
            "galleries": {robot: self.galleries[robot].figures() for robot in sorted(self.galleries)},
            "timeline": self.timeline.figures(),
        }

    def _take(self, log: Log) -> None:
        """The one loop over all messages; what is seldom has a function of its own."""
        add, look = self.metrics.add, self.look
        drawn = look.pictures or look.episode is not None
        takers: dict[str, Callable[[LogChannel, Any], None]] = {
            LEARNER.name: self._learner,
            **({HEALTH.name: self._health, LOG.name: self._line} if drawn else {}),
        }
        trained: dict[str, LearningCurve] = {}
        for series, message, _, _ in log.decoded():
            try:
                if not add(series.key, message):
                    continue
                topic = series.topic
                if topic == STEP.name:
                    training = trained.get(series.key)
                    if training is None:
                        training = trained[series.key] = self.training.setdefault(message.robot, LearningCurve())
                    training.step(message)
                    if drawn:
                        self._draw(series, message)
                elif topic == EXCHANGE.name or topic == EPISODE.name:
                    if drawn:
                        self._keep(series, message)
                elif taker := takers.get(topic):
                    taker(series, message)
            except Exception as error:  # one message is one message: the log goes on
                log.malformed += 1
                self._rejected.reject(series.key, error)

    def _draw(self, series: LogChannel, step: Any) -> None:
        known = self._drawn.get(series)
        if known is None:
            robot, _, name = series.place.partition("/")
            places = self.places.setdefault(robot, InterventionMap())
            gallery = self._gallery(robot)
            known = self._drawn[series] = places, gallery, gallery.source(name)
        places, gallery, source = known
        if len(state := step.state[:2]) == 2:
            places.step(state, step)
        gallery.step(source, step)
        self.timeline.step(step.header.wall_time)

    def _keep(self, series: LogChannel, message: Any) -> None:
        kept = self._kept.get(series)
        if kept is None:
            robot, _, name = series.place.partition("/")
            source = self._gallery(robot).source(name)
            kept = self._kept[series] = source.exchanges if series.topic == EXCHANGE.name else source.about
        kept.append(message)

    def _gallery(self, robot: str) -> EpisodeSampler:
        gallery = self.galleries.get(robot)
        if gallery is None:
            gallery = self.galleries[robot] = EpisodeSampler(
                self.log.robots.named(robot), self.look.episode, self.look.actor
            )
            gallery.label = self.prefix
        return gallery

    def _learner(self, _: LogChannel, message: Any) -> None:
        self.training.setdefault(message.robot, LearningCurve()).learner(message)

    def _health(self, _: LogChannel, message: Any) -> None:
        self.timeline.health(message.process, message)

    def _line(self, _: LogChannel, message: Any) -> None:
        self.timeline.line(message.process, message)

    def about(self) -> Figures:
        """The run's row: how it was set up, what came of it, and what is missing."""
        metrics, log = self.metrics, self.log
        about = log.metadata.get("run", {})
        setup: Figures = {name: about.get(name) for name in SETUP}
        if (conditions := log.metadata.get("conditions")) is not None:
            setup["perception"] = perception_in(conditions)
        if setup["seed"] is not None and setup["seed"].lstrip("-").isdigit():
            setup["seed"] = int(setup["seed"])
        return {
            **setup,
            **closed_loop([metrics.actors[name] for name in sorted(metrics.actors)]),
            "seconds": metrics.seconds(),
            "messages": sum(stream.received for stream in metrics.streams.values()),
            "missing": sum(stream.missing for stream in metrics.streams.values()),
            "duplicates": sum(stream.duplicates for stream in metrics.streams.values()),
            "files": len(log.paths),
            "cuts": [str(cut) for cut in log.cuts],
            "metadata": _metadata(log),
        }


def perception_in(conditions: Mapping[str, str]) -> str:
    """What the conditions of a run say of where free space came from, in a word or two."""
    kind = conditions.get("perception", "map")
    return f"{kind} with tracks" if conditions.get("tracks") == "True" else kind


class LogAnalysis:
    """Several runs beside each other: counts are summed up, curves and processes stay each run's own."""

    def __init__(self, parts: Sequence[RunAnalysis]) -> None:
        self.parts = parts

    def figures(self) -> Figures:
        """All figures; `runs` has those of each run. With several runs, their labels go before the names of actors,
        learners, processes and of the robot kinds in `training`."""
        rows = {part.label: part.about() for part in self.parts}
        logs = [part.log for part in self.parts]
        prefixes = [part.prefix if len(self.parts) > 1 else "" for part in self.parts]
        every = together({prefix: part.metrics for prefix, part in zip(prefixes, self.parts, strict=True)})
        return {
            **_common([{name: run[name] for name in SETUP} for run in rows.values()], SETUP),
            **every,
            "training": {
                prefix + robot: part.training[robot].figures()
                for prefix, part in zip(prefixes, self.parts, strict=True)
                for robot in sorted(part.training)
            },
            "runs": rows,
            "metadata": _common([run["metadata"] for run in rows.values()]),
            "log": [str(path) for log in logs for path in log.paths],
            "segments": [_segment(segment) for log in logs for segment in log.segments],
            "cuts": [str(cut) for log in logs for cut in log.cuts],
            "malformed": sum(log.malformed for log in logs),
            **self._episode(),
        }

    def each(self) -> dict[str, tuple[Figures, Figures]]:
        """Figures and pictures of every run by itself, by its label."""
        return {part.label: (part.figures(), part.pictures()) for part in self.parts}

    def _episode(self) -> Figures:
        """The episode that was asked for, of every run."""
        wanted = next((part.look.episode for part in self.parts), None)
        if wanted is None:
            return {}
        galleries = [part.galleries[robot] for part in self.parts for robot in sorted(part.galleries)]
        return {"episode": wanted, "episode_detail": [episode for gallery in galleries for episode in gallery.found]}


def analyse_runs(paths: Paths, look: AnalysisOptions | None = None) -> LogAnalysis:
    """Everything about the logs at `paths`, run by run.

    Raises:
        NoLog: there is none.
        NotALog: a file is something else.
    """
    runs = by_run(find(paths))
    several = len(runs) > 1
    return LogAnalysis(
        [RunAnalysis(label, Log(files), look, f"{label}/" if several else "") for label, files in runs.items()]
    )


def _metadata(log: Log) -> Figures:
    """The log's metadata but for its legend; the configuration as an object."""
    found: Figures = {name: dict(values) for name, values in log.metadata.items() if name != "brakeline"}
    if "json" in found.get("configuration", {}):
        with contextlib.suppress(ValueError):  # else it is shown as it is
            found["configuration"] = json.loads(found["configuration"]["json"])
    return found


def _common(all_: list[Figures], names: tuple[str, ...] | None = None) -> Figures:
    """What is the same in all; with `names`, None for what is not."""
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

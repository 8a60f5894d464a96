"""Reads logs once, front to back, and gives all that can be said of them, in memory that does not grow with them."""

from __future__ import annotations

import contextlib
import json
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from logs.container import Series
from logs.gallery import Gallery, Source
from logs.metrics import Metrics, closed_loop, covered
from logs.places import Places
from logs.reader import Log, Paths, by_run, find
from logs.tally import Figures
from logs.timeline import Timeline
from logs.training import Training
from messaging.tolerant import Tolerance
from messaging.topics import EPISODE, EXCHANGE, HEALTH, LEARNER, LOG, STEP

SETUP = ("method", "certificate", "policy", "arena", "seed")


@dataclass
class Look:
    """What is wanted besides the figures."""

    pictures: bool = False  # what the report draws
    episode: int | None = None  # this one in detail ...
    actor: str | None = None  # ... of this actor; None: of all


class Analysis:
    """Takes whole runs; `figures` and `pictures` are what they come to, together."""

    def __init__(self, look: Look | None = None) -> None:
        self.look = look or Look()
        self.metrics = Metrics()
        self.training: dict[str, Training] = {}  # by robot kind
        self.places: dict[str, Places] = {}
        self.galleries: dict[str, Gallery] = {}
        self.timeline = Timeline()
        self.runs: dict[str, Figures] = {}
        self.logs: list[Log] = []
        self._drawn: dict[Series, tuple[Places, Gallery, Source]] = {}
        self._kept: dict[Series, deque[Any]] = {}
        self._tolerance = Tolerance()

    def run(self, label: str, log: Log, alone: bool) -> None:
        """Take the log of a run. If it is not `alone`, `label` goes before the names of its actors and processes."""
        prefix = "" if alone else f"{label}/"
        self.metrics.prefix = prefix
        for training in self.training.values():
            training.begins()
        for gallery in self.galleries.values():
            gallery.label = prefix
        before = set(self.metrics.streams)
        self._take(log)
        for gallery in self.galleries.values():
            gallery.close()
        self._drawn.clear()
        self._kept.clear()
        self.logs.append(log)
        self.runs[label] = self._about(log, prefix, before)

    def figures(self) -> Figures:
        """All figures of all runs; `runs` has those that differ, by run."""
        cuts = [str(cut) for log in self.logs for cut in log.cuts]
        return {
            **_common([{name: run[name] for name in SETUP} for run in self.runs.values()], SETUP),
            **self.metrics.figures(),
            "training": {robot: self.training[robot].figures() for robot in sorted(self.training)},
            "runs": self.runs,
            "metadata": _common([run["metadata"] for run in self.runs.values()]),
            "log": [str(path) for log in self.logs for path in log.paths],
            "segments": [_segment(segment) for log in self.logs for segment in log.segments],
            "cuts": cuts,
            "malformed": sum(log.malformed for log in self.logs),
            **self._episode(),
        }

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
        takers: dict[str, Callable[[Series, Any], None]] = {
            LEARNER.name: self._learner,
            **({HEALTH.name: self._health, LOG.name: self._line} if drawn else {}),
        }
        trained: dict[str, Training] = {}
        for series, message, _, _ in log.decoded():
            try:
                if not add(series.key, message):
                    continue
                topic = series.topic
                if topic == STEP.name:
                    training = trained.get(series.key)
                    if training is None:
                        training = trained[series.key] = self.training.setdefault(message.robot, Training())
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
                self._tolerance.note(series.key, error)

    def _draw(self, series: Series, step: Any) -> None:
        known = self._drawn.get(series)
        if known is None:
            robot, _, name = series.place.partition("/")
            places = self.places.setdefault(robot, Places())
            gallery = self._gallery(robot)
            known = self._drawn[series] = places, gallery, gallery.source(name)
        places, gallery, source = known
        if len(state := step.state[:2]) == 2:
            places.step(state, step)
        gallery.step(source, step)
        self.timeline.step(step.header.wall_time)

    def _keep(self, series: Series, message: Any) -> None:
        kept = self._kept.get(series)
        if kept is None:
            robot, _, name = series.place.partition("/")
            source = self._gallery(robot).source(name)
            kept = self._kept[series] = source.exchanges if series.topic == EXCHANGE.name else source.about
        kept.append(message)

    def _gallery(self, robot: str) -> Gallery:
        gallery = self.galleries.get(robot)
        if gallery is None:
            gallery = self.galleries[robot] = Gallery(robot, self.look.episode, self.look.actor)
            gallery.label = self.metrics.prefix
        return gallery

    def _learner(self, _: Series, message: Any) -> None:
        self.training.setdefault(message.robot, Training()).known(message.weights_version)

    def _health(self, _: Series, message: Any) -> None:
        self.timeline.health(self.metrics.prefix + message.process, message)

    def _line(self, _: Series, message: Any) -> None:
        self.timeline.line(self.metrics.prefix + message.process, message)

    def _about(self, log: Log, prefix: str, before: set[tuple[str, int]]) -> Figures:
        """A run's row: how it was set up, what came of it, and what is missing."""
        metrics = self.metrics
        names = sorted(name for name in metrics.actors if name.startswith(prefix))
        streams = {place: stream for place, stream in metrics.streams.items() if place not in before}
        spans = metrics.spans(streams)
        about = log.metadata.get("run", {})
        setup: Figures = {name: about.get(name) for name in SETUP}
        if setup["seed"] is not None and setup["seed"].lstrip("-").isdigit():
            setup["seed"] = int(setup["seed"])
        return {
            **setup,
            **closed_loop([metrics.actors[name] for name in names]),
            "seconds": covered(spans.values()),
            "messages": sum(stream.received for stream in streams.values()),
            "missing": sum(stream.missing for stream in streams.values()),
            "duplicates": sum(stream.duplicates for stream in streams.values()),
            "files": len(log.paths),
            "cuts": [str(cut) for cut in log.cuts],
            "metadata": _metadata(log),
        }

    def _episode(self) -> Figures:
        if self.look.episode is None:
            return {}
        found = [episode for robot in sorted(self.galleries) for episode in self.galleries[robot].found]
        return {"episode": self.look.episode, "episode_detail": found}


def analysed(paths: Paths, look: Look | None = None) -> Analysis:
    """Everything about the logs at `paths`, all runs together.

    Raises:
        NoLog: there is none.
        NotALog: a file is something else.
    """
    analysis = Analysis(look)
    runs = by_run(find(paths))
    for label, files in runs.items():
        analysis.run(label, Log(files), alone=len(runs) == 1)
    return analysis


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

"""What Foxglove shows of a run without any set-up: its own well-known schemas beside our messages, in the same log.

`foxglove/arena/ROBOT/ACTOR`, `foxglove/decision/…`, `foxglove/lidar/…`, `foxglove/frames/…` and `foxglove/log`. Our
messages are protobuf too, so rewards and margins are plotted from the recorded topics themselves.

A channel for each actor: after a jump Foxglove shows the latest message of every channel, so each is complete.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from google.protobuf.message import Message

from brakeline.logs import foxglove_scene
from brakeline.logs.reader import Record
from brakeline.logs.recorded_robots import RecordedRobots
from brakeline.logs.segment import Entry
from brakeline.messaging import brakeline_pb2 as pb
from brakeline.messaging.bus import Sample
from brakeline.messaging.robot import Robot, UnknownRobot
from brakeline.messaging.task import RobotWithTask
from brakeline.messaging.topics import EPISODE, EXCHANGE, LOG, STEP
from brakeline.safety.perception.displayed_map import reserved_boxes

log = logging.getLogger("brakeline.foxglove")

ROOT = "foxglove"
RATE = 10.0  # Hz of wall time and actor; interventions are always drawn
GAP = 1.2  # from the middle of one arena to the next, in edges of an arena

Decode = Callable[[], Any]


@dataclass
class ArenaLayout:
    """Where the arenas stand in the world: a row for each robot kind, an arena for each actor, as they come."""

    _rows: dict[str, tuple[float, float, list[str]]] = field(default_factory=dict)  # y, edge, actors
    _next: float = 0.0  # y of the edge of the row before

    def of(self, robot: str, actor: str, edge: float) -> tuple[float, float]:
        """x and y [m] of the middle of an actor's arena; `edge` [m] counts when a kind's first arena comes."""
        if robot not in self._rows:
            self._rows[robot] = (self._next - 0.5 * GAP * edge, edge, [])
            self._next -= GAP * edge
        y, edge, actors = self._rows[robot]
        if actor not in actors:
            actors.append(actor)
        return GAP * edge * actors.index(actor), y


@dataclass
class _Actor:
    """What is known of one actor, between its messages."""

    robot: Robot
    name: str
    site: tuple[float, float]
    exchange: Decode | None = None  # the latest; decoded if it is drawn
    waiting: tuple[pb.Step, int] | None = None  # a step to be drawn, and when it came
    last: pb.Exchange | None = None  # the latest that was decoded
    drawn: float = -math.inf  # s


class FoxgloveConverter:
    """Turns messages into Foxglove's, one by one. Whatever is wrong with one, there is only no picture of it."""

    def __init__(self, rate: float = RATE, robots: RecordedRobots | None = None) -> None:
        """rate: steps drawn per second and actor, by the time when they came; infinite: every one. robots: those that
        the messages name; the rays of a robot without a task are not drawn."""
        self._robots = robots or RecordedRobots()
        self.failures = 0
        self._spacing = 1.0 / rate
        self._sites = ArenaLayout()
        self._actors: dict[str, _Actor] = {}
        self._takers: dict[str, Callable[[str, Decode, int], list[Entry]]] = {
            EPISODE.name: self._episode,
            EXCHANGE.name: self._exchange,
            STEP.name: self._step,
            LOG.name: self._log_line,
        }

    def from_sample(self, sample: Sample) -> list[Entry]:
        """As the recorder and `brakeline watch` receive it."""
        return self._take(sample.topic.name, sample.key, sample.message, sample.received)

    def from_record(self, record: Record) -> list[Entry]:
        """As it stands in a log."""
        return self._take(record.topic, record.key, lambda: record.message, record.log_time)

    def _take(self, topic: str, key: str, decode: Decode, time: int) -> list[Entry]:
        taker = self._takers.get(topic)
        if taker is None:
            return []
        try:
            return taker(key, decode, time)
        except Exception as error:  # pictures are never worth a message: the recorder goes on
            self.failures += 1
            if self.failures == 1:
                log.warning("no picture of a message at %s: %s: %s", key, type(error).__name__, error)
            return []

    def _episode(self, key: str, decode: Decode, time: int) -> list[Entry]:
        episode = decode()
        robot, name = self._robots.named(episode.robot), episode.actor
        if robot is None:
            raise UnknownRobot(f"no robot is called {episode.robot!r}")
        site = self._sites.of(robot.name, name, 2.0 * foxglove_scene.half_width(episode))
        actor = self._actors.setdefault(_source(key), _Actor(robot, name, site))
        actor.waiting = None
        return [
            _entry(actor, "arena", foxglove_scene.arena(robot, episode, time), time),
            _entry(actor, "frames", foxglove_scene.frames(robot, name, site, episode.start, time), time),
        ]

    def _exchange(self, key: str, decode: Decode, time: int) -> list[Entry]:
        actor = self._actors.get(_source(key))
        if actor is None:
            return []
        actor.exchange = decode
        return self._draw(actor)

    def _step(self, key: str, decode: Decode, time: int) -> list[Entry]:
        actor = self._actors.get(_source(key))
        if actor is None:  # its arena is not known yet
            return []
        step: pb.Step = decode()
        calm = step.decision in (pb.UNKNOWN, pb.ALLOWED) and not step.fallback
        if calm and time * 1e-9 - actor.drawn < self._spacing:
            return []
        actor.waiting = step, time
        return self._draw(actor)

    def _draw(self, actor: _Actor) -> list[Entry]:
        """The step that waits to be drawn, unless the exchange that belongs to it is still on its way."""
        if actor.waiting is None:
            return []
        step, time = actor.waiting
        exchange: pb.Exchange | None = None
        if step.decision != pb.UNKNOWN:
            exchange = actor.exchange() if actor.exchange is not None else None
            actor.last = exchange or actor.last
            asked = (-1, -1) if exchange is None else (exchange.request.episode, exchange.request.step)
            if asked < (step.episode, step.step):
                return []
            if asked > (step.episode, step.step):
                exchange = None
        actor.waiting, actor.drawn = None, time * 1e-9
        robot, name = actor.robot, actor.name
        pictures = [
            _entry(actor, "frames", foxglove_scene.frames(robot, name, actor.site, step.state, time), time),
            _entry(
                actor, "decision", foxglove_scene.decision(robot, step, exchange, time, self._promises(exchange)), time
            ),
        ]
        if isinstance(robot, RobotWithTask):
            rays = foxglove_scene.lidar(robot.task.rays, name, step.next_observation, time)
            pictures.append(_entry(actor, "lidar", rays, time))
        return pictures

    def _promises(self, exchange: pb.Exchange | None) -> list[np.ndarray]:
        """What the other robots of its world promised last, as far as it was drawn."""
        if exchange is None:
            return []
        others = set(exchange.request.fleet) - {exchange.request.actor}
        told = [(a.robot, a.last) for a in self._actors.values() if a.name in others and a.last is not None]
        return [reserved_boxes(robot, last) for robot, last in told]

    def _log_line(self, key: str, decode: Decode, time: int) -> list[Entry]:
        return [_stored(f"{ROOT}/log", foxglove_scene.log_line(decode(), time), time)]


def _source(key: str) -> str:
    """ROBOT/ACTOR of a key."""
    return key.split("/", 1)[1]


def _entry(actor: _Actor, what: str, message: Message, time: int) -> Entry:
    return _stored(f"{ROOT}/{what}/{actor.robot.name}/{actor.name}", message, time)


def _stored(key: str, message: Message, time: int) -> Entry:
    return Entry(key, type(message), message.SerializeToString(), time, time, 0)

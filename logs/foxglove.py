"""Convert messages for Foxglove: its well-known schemas, on channels beside the recorded ones in the same log.

`foxglove/arena/ROBOT/ACTOR`, `foxglove/decision/…`, `foxglove/lidar/…`, `foxglove/frames/…` and `foxglove/log`. The
recorded topics are protobuf, so Foxglove plots rewards and margins from them directly.

Each actor has channels of its own: after a seek Foxglove shows the latest message of every channel, so each message is
a complete scene.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from google.protobuf.message import Message

from brakeline.errors import Implausible, UnknownRobot
from brakeline.logs import foxglove_scene
from brakeline.logs.arena_view import half_width
from brakeline.logs.episode_stats import INTERVENTIONS, kind_of
from brakeline.logs.reader import Record
from brakeline.logs.recorded_robots import RecordedRobots
from brakeline.logs.segment import Entry
from brakeline.messaging import brakeline_pb2 as pb
from brakeline.messaging.bus import Sample
from brakeline.messaging.robot import Robot
from brakeline.messaging.task import RobotWithTask
from brakeline.messaging.topics import EPISODE, EXCHANGE, LOG, STEP
from brakeline.safety.perception.displayed_map import reserved_boxes

log = logging.getLogger("brakeline.foxglove")

ROOT = "foxglove"
RATE = 10.0  # Hz per actor and kind of decision, wall time
MOST_ACTORS = 500  # more are not drawn
GAP = 1.2  # distance between the centers of neighbouring arenas, in edges of an arena

Decode = Callable[[], Any]


@dataclass
class ArenaLayout:
    """Place the arenas in the world: one row for each robot kind, one arena for each actor, in the order of arrival."""

    _rows: dict[str, tuple[float, float, list[str]]] = field(default_factory=dict)  # y, edge, actors
    _next: float = 0.0  # y of the edge of the row before

    def position(self, robot: str, actor: str, edge: float) -> tuple[float, float]:
        """Return x and y [m] of an actor's arena; `edge` [m] of a robot kind's first arena sets the size of its row."""
        if robot not in self._rows:
            self._rows[robot] = (self._next - 0.5 * GAP * edge, edge, [])
            self._next -= GAP * edge
        y, edge, actors = self._rows[robot]
        if actor not in actors:
            actors.append(actor)
        return GAP * edge * actors.index(actor), y


@dataclass
class _Actor:
    """The latest messages of one actor."""

    robot: Robot
    name: str
    site: tuple[float, float]
    exchange: Decode | None = None  # the latest; decoded only when it is drawn
    waiting: tuple[pb.Step, int] | None = None  # a step to draw, and its time of receipt, ns
    last: pb.Exchange | None = None  # the latest decoded exchange
    drawn: dict[int, float] = field(default_factory=dict)  # s, receipt of the last drawn step, by kind of decision


class FoxgloveConverter:
    """Converts messages to Foxglove's schemas, one by one. A malformed message has no scene and adds to `failures`."""

    def __init__(self, rate: float = RATE, robots: RecordedRobots | None = None) -> None:
        """Create a converter.

        Args:
            rate: drawn steps per second and actor, and as many more with each kind of intervention, by time of receipt;
                infinity draws every step. A robot in real time intervenes less often, so all its interventions are
                drawn.
            robots: the robots that messages name. The rays of a robot without a task are not drawn.
        """
        self._robots = robots or RecordedRobots()
        self.failures = 0
        self._spacing = 1.0 / rate
        self._layout = ArenaLayout()
        self._actors: dict[str, _Actor] = {}
        self._converters: dict[str, Callable[[str, Decode, int], list[Entry]]] = {
            EPISODE.name: self._episode,
            EXCHANGE.name: self._exchange,
            STEP.name: self._step,
            LOG.name: self._log_line,
        }

    def from_sample(self, sample: Sample) -> list[Entry]:
        return self._convert(sample.topic.name, sample.key, sample.message, sample.received)

    def from_record(self, record: Record) -> list[Entry]:
        return self._convert(record.topic, record.key, lambda: record.message, record.log_time)

    def _convert(self, topic: str, key: str, decode: Decode, time: int) -> list[Entry]:
        convert = self._converters.get(topic)
        if convert is None:
            return []
        try:
            return convert(key, decode, time)
        except Exception as error:  # recording a message matters more than drawing it
            self.failures += 1
            if self.failures == 1:
                log.warning("cannot draw a message at %s: %s: %s", key, type(error).__name__, error)
            return []

    def _episode(self, key: str, decode: Decode, time: int) -> list[Entry]:
        episode = decode()
        robot, name = self._robots.named(episode.robot), episode.actor
        if robot is None:
            raise UnknownRobot(f"no robot is called {episode.robot!r}")
        if _source(key) not in self._actors and len(self._actors) >= MOST_ACTORS:
            raise Implausible(f"{name} is not drawn: there are already {MOST_ACTORS} actors")
        site = self._layout.position(robot.name, name, 2.0 * half_width(episode))
        actor = self._actors.setdefault(_source(key), _Actor(robot, name, site))
        actor.waiting = None
        arena = foxglove_scene.arena(robot, episode, time)
        frames = foxglove_scene.frames(robot, name, site, episode.start, time)
        return _entries(actor, time, arena=arena, frames=frames)

    def _exchange(self, key: str, decode: Decode, time: int) -> list[Entry]:
        actor = self._actors.get(_source(key))
        if actor is None:
            return []
        actor.exchange = decode
        return self._draw(actor)

    def _step(self, key: str, decode: Decode, time: int) -> list[Entry]:
        actor = self._actors.get(_source(key))
        if actor is None:  # its Episode message has not come yet
            return []
        step: pb.Step = decode()
        kind = _kind(step)
        times = (actor.drawn.get(kind, -math.inf),) if kind else actor.drawn.values()
        if time * 1e-9 - max(times, default=-math.inf) < self._spacing:
            return []
        actor.waiting = step, time
        return self._draw(actor)

    def _draw(self, actor: _Actor) -> list[Entry]:
        """Draw the waiting step, unless its exchange has not come yet."""
        if actor.waiting is None:
            return []
        step, time = actor.waiting
        exchange: pb.Exchange | None = None
        if step.decision != pb.UNKNOWN:
            exchange = actor.exchange() if actor.exchange is not None else None
            actor.last = exchange or actor.last
            decided = (-1, -1) if exchange is None else (exchange.request.episode, exchange.request.step)
            if decided < (step.episode, step.step):
                return []
            if decided > (step.episode, step.step):
                exchange = None
        actor.waiting, actor.drawn[_kind(step)] = None, time * 1e-9
        robot, name = actor.robot, actor.name
        scenes: dict[str, Message] = {
            "frames": foxglove_scene.frames(robot, name, actor.site, step.state, time),
            "decision": foxglove_scene.decision(robot, step, exchange, time, self._reservations(exchange)),
        }
        if isinstance(robot, RobotWithTask):
            scenes["lidar"] = foxglove_scene.lidar(robot.task.rays, name, step.next_observation, time)
        return _entries(actor, time, **scenes)

    def _reservations(self, exchange: pb.Exchange | None) -> list[np.ndarray]:
        """Return the boxes that the other robots of the world reserved last, as far as their exchanges were drawn."""
        if exchange is None:
            return []
        others = set(exchange.request.fleet) - {exchange.request.actor}
        latest = [(a.robot, a.last) for a in self._actors.values() if a.name in others and a.last is not None]
        return [reserved_boxes(robot, last) for robot, last in latest]

    def _log_line(self, key: str, decode: Decode, time: int) -> list[Entry]:
        return [_stored(f"{ROOT}/log", foxglove_scene.log_line(decode(), time), time)]


def _kind(step: pb.Step) -> int:
    """Return the kind of the intervention at a step; 0: there was none."""
    kind = kind_of(step)
    return kind if kind in INTERVENTIONS else 0


def _source(key: str) -> str:
    """Return ROBOT/ACTOR of a key."""
    return key.split("/", 1)[1]


def _entries(actor: _Actor, time: int, **scenes: Message) -> list[Entry]:
    place = f"{actor.robot.name}/{actor.name}"
    return [_stored(f"{ROOT}/{what}/{place}", message, time) for what, message in scenes.items()]


def _stored(key: str, message: Message, time: int) -> Entry:
    return Entry(key, type(message), message.SerializeToString(), time, time, 0)

"""Select a bounded number of episodes for the report while a log is read.

For each robot kind: the nearest misses, collisions, the episodes with the most failsafes, a sample spread evenly over
the log, and the last episode. Of the others, the report has sketches.
"""

from __future__ import annotations

import heapq
import json
import math
from collections import deque
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field, replace
from functools import cache, partial

from brakeline.logs.episode_stats import INTERVENTIONS, Figures, closest_of, kind_of
from brakeline.logs.episode_view import FEW_TUBES, MOST_TUBES, picture, rows, sketch
from brakeline.logs.json_values import finite
from brakeline.messaging import brakeline_pb2 as pb
from brakeline.messaging.robot import Robot

NEAREST = 8
COLLISIONS = 8
MOST_FAILSAFES = 4  # episodes with the most failsafes
SPREAD = 24
SKETCHES = 2000  # episodes in short; of a longer log, evenly spread ones
MOST_POINTS, FEWEST_POINTS = 40, 6  # steps in a sketch
POINTS = 8000  # a new sketch has about this many steps, divided by the number of episodes so far
MOST_STEPS = 3000  # steps of one episode in memory; of the wanted one, all
MOST_EXCHANGES = 600  # latest exchanges of one actor in memory


@dataclass
class EpisodeRecord:
    """The part of one actor's episode that is in the log; at least one step."""

    label: str  # prefix of the run; empty if there is only one run
    number: int
    about: pb.Episode | None  # None: the log does not have the beginning of the episode
    steps: list[pb.Step] = field(default_factory=list)  # those in memory; the counts below are of all
    count: int = 0
    last: pb.Step = field(default_factory=pb.Step)
    reward: float = 0.0
    collided: bool = False
    closest: float = math.inf  # m
    interventions: int = 0
    failsafes: int = 0
    until: int = 0  # steps of all actors of the robot kind up to the episode's latest step
    actor_exchanges: Iterable[pb.Exchange] = ()  # of this actor, also of other episodes
    other_exchanges: Iterable[pb.Exchange] = ()  # of the other robots of the world, also of other episodes
    whole: bool = False  # keep all steps in memory

    def add(self, step: pb.Step) -> None:
        if self.whole or len(self.steps) < MOST_STEPS:
            self.steps.append(step)
        self.count, self.last = self.count + 1, step
        self.reward += step.reward
        self.collided = self.collided or step.collision
        closest, kind = closest_of(step), kind_of(step)
        if closest < self.closest:
            self.closest = closest
        self.interventions += kind in INTERVENTIONS
        self.failsafes += kind == pb.FAILSAFE

    def exchanges(self) -> dict[int, pb.Exchange]:
        """Return the episode's exchanges by step."""
        return {e.request.step: e for e in self.actor_exchanges if self._has(e)}

    def exchanges_of_others(self) -> dict[int, list[pb.Exchange]]:
        """Return the exchanges of the other robots of the world, by step."""
        by_step: dict[int, list[pb.Exchange]] = {}
        for e in self.other_exchanges:
            if self._has(e):
                by_step.setdefault(e.request.step, []).append(e)
        return by_step

    def _has(self, exchange: pb.Exchange) -> bool:
        """Return whether this is an exchange of the episode. An actor that was started again may repeat a number."""
        return exchange.request.episode == self.number and exchange.header.run == self.last.header.run

    @property
    def actor(self) -> str:
        return self.label + self.last.actor

    def outcome(self) -> str:
        last = self.last
        if self.collided:
            return "collision"
        if last.contact_moving or last.contact_standing:
            return "run into" if last.contact_standing else "contact"
        if last.contact_robot:
            return "contact"
        if last.goal:
            return "goal"
        return "timeout" if last.truncated else "unfinished"


class ActorBuffer:
    """The running episode and the latest messages of one actor, and all exchanges of the wanted episode."""

    def __init__(self) -> None:
        self.wanted: list[pb.Exchange] = []
        self.running: EpisodeRecord | None = None
        self.about: deque[pb.Episode] = deque(maxlen=2)
        self.exchanges: deque[pb.Exchange] = deque(maxlen=MOST_EXCHANGES)

    def episode(self, number: int) -> pb.Episode | None:
        return next((about for about in self.about if about.episode == number), None)


class EpisodeSampler:
    """Select episodes of one robot kind.

    Attributes:
        label: prefix of the run.
        sketches: most episodes in short.
        wanted: number of an episode that is always selected, of every actor or only of `actor` (with or without label).
        requested_episodes: the episodes with this number, with all their steps.
    """

    def __init__(
        self,
        robot: Robot | None,
        label: str = "",
        wanted: int | None = None,
        actor: str | None = None,
        sketches: int = SKETCHES,
    ) -> None:
        self.robot, self.label, self.sketches = robot, label, sketches
        self.wanted, self.actor = wanted, actor
        self.requested_episodes: list[Figures] = []
        self.last: EpisodeRecord | None = None
        self._sources: dict[str, ActorBuffer] = {}
        self._nearest: list[tuple[float, int, Figures]] = []  # heaps: the entry to replace comes first
        self._most_failsafes: list[tuple[float, int, Figures]] = []
        self._collisions: list[Figures] = []
        self._spread: dict[int, Figures] = {}
        self._stride = 1
        self._sketches: dict[int, bytes] = {}  # JSON, which takes a sixth of the memory
        self._sketch_stride = 1
        self._count = 0
        self._steps = 0

    def source(self, name: str) -> ActorBuffer:
        """Return the buffer of an actor; create it for a new actor."""
        name = self.label + name
        return self._sources.setdefault(name, ActorBuffer())

    def step(self, source: ActorBuffer, step: pb.Step) -> None:
        """Add a step. An episode is evaluated when the next one begins, because exchanges may follow their steps."""
        episode = source.running
        number = step.episode
        if episode is None or episode.number != number or step.step == 0:
            if episode is not None:
                self._ended(source, episode)
            about, whole = source.episode(number), number == self.wanted
            episode = source.running = EpisodeRecord(self.label, number, about, whole=whole)
        episode.add(step)
        self._steps += 1
        episode.until = self._steps

    def exchange(self, source: ActorBuffer, exchange: pb.Exchange) -> None:
        """Add an exchange of an actor."""
        source.exchanges.append(exchange)
        if exchange.request.episode == self.wanted:
            source.wanted.append(exchange)

    def close(self) -> None:
        """Evaluate the running episodes: the run has ended."""
        for source in self._sources.values():
            if source.running is not None:
                episode, source.running = source.running, None
                self._ended(source, episode)
        self._sources.clear()

    def figures(self) -> Figures:
        """Return the selected `episodes`, and sketches of the `rest`, by their order in the log.

        `near` has the orders of the nearest misses, smallest clearance first. `total` counts all episodes of the log.
        """
        near = [item for *_, item in sorted(self._nearest, key=lambda entry: -entry[0])]
        failsafes = [item for *_, item in self._most_failsafes]
        last = [self._picture(self.last, self._count - 1)] if self.last is not None else []
        every = (*self._spread.values(), *last, *failsafes, *self._collisions, *near, *self.requested_episodes)
        selected = {item["order"]: item for item in every}
        rest = [json.loads(item) for order, item in sorted(self._sketches.items()) if order not in selected]
        return {
            "near": [item["order"] for item in near],
            "episodes": [selected[order] for order in sorted(selected)],
            "rest": rest,
            "total": self._count,
        }

    def _ended(self, source: ActorBuffer, episode: EpisodeRecord) -> None:
        """Select the episode if it belongs to one of the groups. Only then is its picture computed, once."""
        order, self._count = self._count, self._count + 1
        pictured = cache(partial(self._picture, episode, order))
        episode.actor_exchanges = source.wanted if episode.whole else source.exchanges
        episode.other_exchanges = self._others(source, episode)
        self.last = replace(episode, actor_exchanges=list(episode.actor_exchanges))
        if math.isfinite(episode.closest):
            _push(self._nearest, -episode.closest, NEAREST, pictured, order)
        if episode.failsafes:
            _push(self._most_failsafes, episode.failsafes, MOST_FAILSAFES, pictured, order)
        if len(self._collisions) < COLLISIONS and episode.outcome() == "collision":
            self._collisions.append(pictured())
        if order % self._stride == 0:
            self._spread[order] = self._picture(episode, order, FEW_TUBES)
            if len(self._spread) > SPREAD:
                self._stride *= 2
                self._spread = {k: item for k, item in self._spread.items() if k % self._stride == 0}
        if order % self._sketch_stride == 0:
            self._sketch(episode, order)
        if episode.number == self.wanted and self.actor in (None, episode.actor, episode.last.actor):
            self.requested_episodes.append(pictured() | {"rows": list(rows(episode, self.robot))})

    def _sketch(self, episode: EpisodeRecord, order: int) -> None:
        """Keep the episode in short. Of too many, keep every second one."""
        points = min(MOST_POINTS, max(FEWEST_POINTS, POINTS // (order + 1)))
        about = {"order": order, "until": episode.until, **sketch(episode, self.robot, points)}
        self._sketches[order] = json.dumps(finite(about)).encode()
        if len(self._sketches) > self.sketches:
            self._sketch_stride *= 2
            self._sketches = {k: item for k, item in self._sketches.items() if k % self._sketch_stride == 0}

    def _others(self, source: ActorBuffer, episode: EpisodeRecord) -> list[pb.Exchange]:
        """Return the exchanges of the other robots of the episode's world; empty for a single robot."""
        own = next((e.request for e in source.exchanges if e.request.episode == episode.number), None)
        names = [] if own is None else [self.label + name for name in own.fleet if name != own.actor]
        return [e for name in names if name in self._sources for e in self._sources[name].exchanges]

    def _picture(self, episode: EpisodeRecord, order: int, tubes: int = MOST_TUBES) -> Figures:
        return {"order": order, "until": episode.until, **picture(episode, self.robot, tubes)}


def _push(
    heap: list[tuple[float, int, Figures]], worth: float, most: int, pictured: Callable[[], Figures], order: int
) -> None:
    """Add an episode to those that are worth most, if it is one of them."""
    if len(heap) < most:
        heapq.heappush(heap, (worth, -order, pictured()))
    elif worth > heap[0][0]:
        heapq.heapreplace(heap, (worth, -order, pictured()))

"""Episodes worth looking at, chosen while a log streams by: a bounded number, each as small as a picture needs.

Of every robot kind the nearest misses are kept, the collisions, those with most failsafes, a sample spread evenly over
the log, and the last.
"""

from __future__ import annotations

import heapq
import math
from collections import deque
from collections.abc import Iterable
from dataclasses import dataclass, field, replace

from brakeline.logs.episode_stats import Figures
from brakeline.logs.episode_view import picture, rows
from brakeline.messaging import brakeline_pb2 as pb
from brakeline.messaging.robot import Robot

NEAREST = 8
COLLISIONS = 8
BRAKED = 4  # those with most failsafes
SPREAD = 24
MOST_STEPS = 3000  # of an episode that are kept
MOST_QUESTIONS = 600  # the latest of an actor, in memory


@dataclass
class EpisodeRecord:
    """An episode of one actor, as far as it was seen."""

    label: str  # of its run; empty if there is only one
    number: int
    about: pb.Episode | None  # None: it began before the log did
    steps: list[pb.Step] = field(default_factory=list)
    closest: float = math.inf  # m
    failsafes: int = 0
    questions: Iterable[pb.Exchange] = ()  # some of which belong to it
    others: Iterable[pb.Exchange] = ()  # of the other robots of its world, some of which belong to it

    def take(self, step: pb.Step) -> None:
        if len(self.steps) < MOST_STEPS:
            self.steps.append(step)
        clearance = step.clearance
        if clearance < self.closest:
            self.closest = clearance
        if step.fallback or step.decision == pb.FAILSAFE:
            self.failsafes += 1

    def exchanges(self) -> dict[int, pb.Exchange]:
        """Its questions and their answers, by step."""
        return {e.request.step: e for e in self.questions if e.request.episode == self.number}

    def beside(self) -> dict[int, list[pb.Exchange]]:
        """The others' questions and their answers, by step."""
        found: dict[int, list[pb.Exchange]] = {}
        for e in self.others:
            if e.request.episode == self.number:
                found.setdefault(e.request.step, []).append(e)
        return found

    @property
    def actor(self) -> str:
        return self.label + self.steps[0].actor

    def outcome(self) -> str:
        last = self.steps[-1]
        if any(step.collision for step in self.steps):
            return "collision"
        if last.contact_moving or last.contact_standing:
            return "run into" if last.contact_standing else "contact"
        if last.contact_robot:
            return "contact"
        if last.goal:
            return "goal"
        return "timeout" if last.truncated else "unfinished"


class ActorBuffer:
    """What of one actor is in memory: its running episode and its latest questions."""

    def __init__(self) -> None:
        self.running: EpisodeRecord | None = None
        self.about: deque[pb.Episode] = deque(maxlen=2)
        self.exchanges: deque[pb.Exchange] = deque(maxlen=MOST_QUESTIONS)

    def episode(self, number: int) -> pb.Episode | None:
        return next((about for about in self.about if about.episode == number), None)


class EpisodeSampler:
    """Takes the messages of one robot kind, and keeps the episodes that are worth it.

    `wanted` is the number of an episode that is kept whatever happens in it, of every actor (or of `actor` alone).
    """

    def __init__(self, robot: Robot | None, wanted: int | None = None, actor: str | None = None) -> None:
        self.robot = robot
        self.label = ""
        self.wanted, self.actor = wanted, actor
        self.found: list[Figures] = []  # the wanted ones, with all their steps
        self.last: EpisodeRecord | None = None
        self._sources: dict[str, ActorBuffer] = {}
        self._nearest: list[tuple[float, int, Figures]] = []  # heaps: the least worth keeping comes first
        self._braked: list[tuple[float, int, Figures]] = []
        self._collisions: list[Figures] = []
        self._spread: dict[int, Figures] = {}
        self._stride = 1
        self._count = 0

    def source(self, name: str) -> ActorBuffer:
        """What is in memory of the actor of that name; new if there is none."""
        name = self.label + name
        source = self._sources.get(name)
        if source is None:
            source = self._sources[name] = ActorBuffer()
        return source

    def step(self, source: ActorBuffer, step: pb.Step) -> None:
        """Take a step of the actor. An episode is looked at when the next begins: questions may come after steps."""
        held = source.running
        number = step.episode
        if held is None or held.number != number or step.step == 0:
            if held is not None:
                self._ended(source, held)
            held = source.running = EpisodeRecord(self.label, number, source.episode(number))
        held.take(step)

    def close(self) -> None:
        """No more comes of this run."""
        for source in self._sources.values():
            if source.running is not None:
                held, source.running = source.running, None
                self._ended(source, held)
        self._sources.clear()

    def figures(self) -> Figures:
        """`near`: the nearest misses, worst first; `episodes`: all that were kept, in the order in which they ended."""
        near = [item for *_, item in sorted(self._nearest, key=lambda entry: -entry[0])]
        braked = [item for *_, item in self._braked]
        last = [self._picture(self.last, self._count - 1)] if self.last is not None else []
        every = (*self._spread.values(), *last, *braked, *self._collisions, *near, *self.found)
        kept = {item["order"]: item for item in every}
        return {"near": [item["order"] for item in near], "episodes": [kept[order] for order in sorted(kept)]}

    def _ended(self, source: ActorBuffer, held: EpisodeRecord) -> None:
        """Keep the episode if it is worth it. Its picture is made only then."""
        order, self._count = self._count, self._count + 1
        held.questions, held.others = source.exchanges, self._others(source, held)
        self.last = replace(held, questions=list(source.exchanges))
        if math.isfinite(held.closest):
            self._push(self._nearest, -held.closest, NEAREST, held, order)
        if held.failsafes:
            self._push(self._braked, held.failsafes, BRAKED, held, order)
        if len(self._collisions) < COLLISIONS and held.outcome() == "collision":
            self._collisions.append(self._picture(held, order))
        if order % self._stride == 0:
            self._spread[order] = self._picture(held, order)
            if len(self._spread) > SPREAD:
                self._stride *= 2
                self._spread = {k: item for k, item in self._spread.items() if k % self._stride == 0}
        if held.number == self.wanted and self.actor in (None, held.actor):
            self.found.append(self._picture(held, order) | {"rows": list(rows(held, self.robot))})

    def _others(self, source: ActorBuffer, held: EpisodeRecord) -> list[pb.Exchange]:
        """What the other robots of its world asked and were answered; alone: nothing."""
        own = next((e.request for e in source.exchanges if e.request.episode == held.number), None)
        names = [] if own is None else [self.label + name for name in own.fleet if name != own.actor]
        return [e for name in names if name in self._sources for e in self._sources[name].exchanges]

    def _push(
        self, heap: list[tuple[float, int, Figures]], worth: float, most: int, held: EpisodeRecord, order: int
    ) -> None:
        if len(heap) < most:
            heapq.heappush(heap, (worth, -order, self._picture(held, order)))
        elif worth > heap[0][0]:
            heapq.heapreplace(heap, (worth, -order, self._picture(held, order)))

    def _picture(self, held: EpisodeRecord, order: int) -> Figures:
        return {"order": order, **picture(held, self.robot)}

"""Which steps have arrived: duplicates are refused, losses counted, and each actor's place is known.

A step's name is (actor, episode, step). Its `index` counts the steps of the actor since its start, across episodes, so
that a loss at an episode's end shows too.
"""

from __future__ import annotations

from bisect import bisect_right
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from brakeline.errors import BadState
from brakeline.learner.checkpoint_state import PartState


@dataclass
class ActorProgress:
    """How far one actor is."""

    last_index: int = 0
    next_episode: int = 0
    fresh_from: int = 0  # steps of episodes before this one are from before the actor's restart: their index is void
    seen: dict[int, list[list[int]]] = field(default_factory=dict)  # per episode: sorted, disjoint [first, last]


def mark(ranges: list[list[int]], step: int) -> bool:
    """Adds `step` to the ranges, which stay sorted, disjoint and unmergeable. False: it was there."""
    after = bisect_right(ranges, step, key=lambda r: r[0])  # the first range that begins behind the step
    if after > 0 and step <= ranges[after - 1][1]:
        return False
    joins_left = after > 0 and ranges[after - 1][1] == step - 1
    joins_right = after < len(ranges) and ranges[after][0] == step + 1
    if joins_left and joins_right:
        ranges[after - 1][1] = ranges.pop(after)[1]
    elif joins_left:
        ranges[after - 1][1] = step
    elif joins_right:
        ranges[after][0] = step
    else:
        ranges.insert(after, [step, step])
    return True


class StepLedger:
    """Every step that was ever taken in; a thousand steps of an unbroken episode cost one range."""

    def __init__(self) -> None:
        self.places: dict[str, ActorProgress] = {}
        self.received = 0  # distinct steps
        self.expected = 0  # steps that actors say they have published
        self.duplicates = 0

    @property
    def missing(self) -> int:
        """Steps published and never seen."""
        return max(0, self.expected - self.received)

    def record(self, actor: str, episode: int, step: int, index: int) -> bool:
        """False: a duplicate, not to be learned from again."""
        place = self.places.setdefault(actor, ActorProgress(last_index=index - 1))
        if not mark(place.seen.setdefault(episode, []), step):
            self.duplicates += 1
            return False
        self.received += 1
        place.next_episode = max(place.next_episode, episode + 1)
        if episode < place.fresh_from:
            self.expected += 1
        elif index > place.last_index:
            self.expected += index - place.last_index
            place.last_index = index
        return True

    def join(self, actor: str, index: int, episode: int) -> int:
        """An actor that has published `index` steps and would begin `episode` next; returns where it shall go on."""
        place = self.places.setdefault(actor, ActorProgress(last_index=index))
        place.next_episode = max(place.next_episode, episode)
        if index < place.last_index:  # it was started anew
            place.last_index, place.fresh_from = index, place.next_episode
        else:  # what it published while no learner listened is lost
            self.expected += index - place.last_index
            place.last_index = index
        return place.next_episode

    def state(self) -> PartState:
        actors = sorted(self.places)
        rows = [
            (number, episode, first, last)
            for number, actor in enumerate(actors)
            for episode, ranges in self.places[actor].seen.items()
            for first, last in ranges
        ]
        values: dict[str, Any] = {
            "actors": {a: [p.last_index, p.next_episode, p.fresh_from] for a, p in sorted(self.places.items())},
            "received": self.received,
            "expected": self.expected,
            "duplicates": self.duplicates,
        }
        return PartState({"seen": np.array(rows, np.int64).reshape(len(rows), 4)}, values)

    def restore(self, state: PartState) -> None:
        actors: dict[str, tuple[int, int, int]] = state.value("actors")
        names = sorted(actors)
        self.places = {name: ActorProgress(*actors[name]) for name in names}
        for number, episode, first, last in state.tensor("seen", (None, 4), "int64").tolist():
            if not 0 <= number < len(names):
                raise BadState(f"seen: actor {number} of {len(names)}")
            self.places[names[number]].seen.setdefault(episode, []).append([first, last])
        self.received, self.expected = state.integer("received"), state.integer("expected")
        self.duplicates = state.integer("duplicates")

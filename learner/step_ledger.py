"""Count the steps that arrive: refuse duplicates, count losses, and know the place of each actor.

A step is identified by (actor, episode, step). Its `index` counts the steps of the actor since the actor's start,
across episodes, so that the loss of an episode's last step shows too.
"""

from __future__ import annotations

from bisect import bisect_right
from dataclasses import dataclass, field

import numpy as np

from brakeline.learner.checkpoint import PartState


@dataclass
class ActorProgress:
    """The place of one actor."""

    last_index: int = 0
    next_episode: int = 0
    fresh_from: int = 0  # earlier episodes are from before the actor's restart: the index of their steps is void
    seen: dict[int, list[list[int]]] = field(default_factory=dict)  # by episode: sorted, disjoint [first, last]


def mark(ranges: list[list[int]], step: int) -> bool:
    """Add a step to sorted, disjoint ranges that do not touch each other. Return False if they contained it."""
    after = bisect_right(ranges, step, key=lambda r: r[0])  # the first range that begins after the step
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
    """All steps that ever arrived. An episode without gaps needs one range, however long it is."""

    def __init__(self) -> None:
        self.places: dict[str, ActorProgress] = {}
        self.received = 0  # distinct steps
        self.expected = 0  # steps that the actors have published, by their indices
        self.duplicates = 0

    @property
    def missing(self) -> int:
        """Number of published steps that never arrived."""
        return max(0, self.expected - self.received)

    def record(self, actor: str, episode: int, step: int, index: int) -> bool:
        """Record a step. Return False if it is a duplicate."""
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

    def steps_of(self, actor: str) -> int:
        """Return how many distinct steps of an actor ever arrived."""
        place = self.places.get(actor, ActorProgress())
        return sum(last - first + 1 for ranges in place.seen.values() for first, last in ranges)

    def refuse(self, actor: str, index: int) -> None:
        """Note a step that arrived, but does not count, so that it does not count as lost."""
        self.places[actor].last_index = max(self.places[actor].last_index, index)

    def join(self, actor: str, index: int, episode: int) -> int:
        """Register an actor that has published `index` steps. Return the episode with which it continues.

        Args:
            episode: the episode that the actor would begin next.
        """
        place = self.places.setdefault(actor, ActorProgress(last_index=index))
        place.next_episode = max(place.next_episode, episode)
        if index < place.last_index:  # the actor was restarted
            place.fresh_from = place.next_episode
        else:  # the steps that it published while no learner listened are lost
            self.expected += index - place.last_index
        place.last_index = index
        return place.next_episode

    def state(self) -> PartState:
        actors = sorted(self.places.items())
        rows = [
            (number, episode, first, last)
            for number, (_, place) in enumerate(actors)
            for episode, ranges in place.seen.items()
            for first, last in ranges
        ]
        counts = {"received": self.received, "expected": self.expected, "duplicates": self.duplicates}
        places = {actor: [place.last_index, place.next_episode, place.fresh_from] for actor, place in actors}
        return PartState({"seen": np.array(rows, np.int64).reshape(len(rows), 4)}, {"actors": places, **counts})

    def restore(self, state: PartState) -> None:
        """Take over the state of a checkpoint."""
        actors: dict[str, tuple[int, int, int]] = state.value("actors")
        names = sorted(actors)
        self.places = {name: ActorProgress(*actors[name]) for name in names}
        for number, episode, first, last in state.tensor("seen", (None, 4), "int64").tolist():
            if not 0 <= number < len(names):
                raise ValueError(f"seen: actor {number} of {len(names)}")
            self.places[names[number]].seen.setdefault(episode, []).append([first, last])
        self.received, self.expected = state.integer("received"), state.integer("expected")
        self.duplicates = state.integer("duplicates")

"""Whose question is answered next: each asker's in turn, so that the many of one delay another's by one at the most."""

from __future__ import annotations

from collections import deque
from typing import Generic, TypeVar

T = TypeVar("T")

EACH = 8  # questions of one asker that wait; a newer one takes the place of the oldest
MOST = 1024  # askers whose questions wait


class FairQueue(Generic[T]):
    """Questions that wait, by who asked. Not for several threads at once."""

    def __init__(self) -> None:
        self._waiting: dict[str, deque[T]] = {}  # in the order of their turns

    def __len__(self) -> int:
        return sum(map(len, self._waiting.values()))

    def add(self, who: str, question: T) -> T | None:
        """Let a question wait; returns the one that can't wait any more, if there is one."""
        if who not in self._waiting:
            if len(self._waiting) == MOST:
                return question
            self._waiting[who] = deque()
        waiting = self._waiting[who]
        waiting.append(question)
        return waiting.popleft() if len(waiting) > EACH else None

    def next(self) -> T:
        """The question whose turn it is. Raises StopIteration when none waits."""
        who = next(iter(self._waiting))
        waiting = self._waiting.pop(who)
        question = waiting.popleft()
        if waiting:
            self._waiting[who] = waiting  # behind the others
        return question

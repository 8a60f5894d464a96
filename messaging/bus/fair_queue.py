"""A queue that serves clients in turn: many queries of one client delay another client's query by at most one.

The newest query of a client comes first. In an overload, a query that has waited for long gets its answer too late
anyway. If the queue served the queries in their order of arrival, all of them would get their answers too late.
"""

from __future__ import annotations

from collections import deque
from typing import Generic, TypeVar

T = TypeVar("T")

MAX_PER_CLIENT = 8  # queries of one client in the queue; a newer query replaces the oldest
MAX_CLIENTS = 1024


class FairQueue(Generic[T]):
    """The waiting queries of each client. Not thread-safe."""

    def __init__(self) -> None:
        self._waiting: dict[str, deque[T]] = {}  # by client, in the order of their turns

    def __len__(self) -> int:
        return sum(map(len, self._waiting.values()))

    def add(self, client: str, query: T) -> T | None:
        """Add a query. Returns the query that is dropped for it, or None: the client's oldest one, or the new one."""
        if client not in self._waiting:
            if len(self._waiting) == MAX_CLIENTS:
                return query
            self._waiting[client] = deque()
        waiting = self._waiting[client]
        waiting.append(query)
        return waiting.popleft() if len(waiting) > MAX_PER_CLIENT else None

    def next(self) -> T:
        """Remove and return the newest query of the next client. Raises StopIteration: the queue is empty."""
        client = next(iter(self._waiting))
        waiting = self._waiting.pop(client)
        query = waiting.pop()
        if waiting:
            self._waiting[client] = waiting  # behind the other clients
        return query

"""Hold received samples in bounded memory, until the thread that works on them has the time."""

from __future__ import annotations

import threading
import time
from collections import Counter, deque
from collections.abc import Iterator

from brakeline.messaging.bus.subscription import Sample
from brakeline.messaging.bus.topic_keys import sender_of

LIMIT = 64 * 2**20  # bytes
SHARE = 0.5  # of the limit, for the samples of one identity
OVERHEAD = 100  # bytes of a sample besides its payload
BATCH = 2**20  # bytes per write, so that a nearly full disk still takes what fits


def size_in_memory(sample: Sample) -> int:
    """Return a lower bound on the memory of a sample, bytes; an empty sample counts too."""
    return OVERHEAD + len(sample.payload)


class Inbox:
    """A thread-safe queue of samples that never blocks: it drops and counts what exceeds its limits.

    The samples of one identity may take `SHARE` of the limit, so that one sender cannot take the place of the others.
    """

    def __init__(self, limit: int = LIMIT) -> None:
        self.limit = limit  # bytes
        self.dropped: Counter[str] = Counter()  # number of dropped samples by key
        self.bytes = 0  # of the waiting samples
        self._bytes_of: Counter[str] = Counter()  # by identity
        self._waiting: deque[tuple[Sample, int, str]] = deque()  # with the size and the identity of each
        self._lock = threading.Lock()

    def __len__(self) -> int:
        return len(self._waiting)

    def put(self, sample: Sample) -> None:
        """Add the sample, or count it as dropped."""
        size, identity = size_in_memory(sample), sender_of(sample.topic, sample.key)
        with self._lock:
            if self.bytes + size > self.limit or self._bytes_of[identity] + size > SHARE * self.limit:
                self.dropped[sample.key] += 1
            else:
                self._count(identity, size)
                self._waiting.append((sample, size, identity))

    def oldest(self) -> list[Sample]:
        """Return the oldest samples, about `BATCH` bytes; they stay in the inbox until `remove`."""
        batch: list[Sample] = []
        total = 0
        with self._lock:
            for sample, one, _ in self._waiting:
                if batch and total + one > BATCH:
                    break
                batch.append(sample)
                total += one
        return batch

    def remove(self, samples: list[Sample]) -> None:
        """Remove the samples that `oldest` returned."""
        with self._lock:
            for _ in samples:
                self._pop()

    def drain(self, seconds: float) -> Iterator[Sample]:
        """Remove and yield samples, oldest first, until the inbox is empty or the time has passed."""
        deadline = time.monotonic() + seconds
        while self._waiting and time.monotonic() < deadline:
            with self._lock:
                sample = self._pop()
            yield sample

    def _pop(self) -> Sample:
        sample, size, identity = self._waiting.popleft()
        self._count(identity, -size)
        return sample

    def _count(self, identity: str, size: int) -> None:
        self.bytes += size
        self._bytes_of[identity] += size
        if not self._bytes_of[identity]:
            del self._bytes_of[identity]

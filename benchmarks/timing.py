"""Timing in one process: medians and percentiles of many calls, after a warm-up."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from time import perf_counter

import numpy as np

Figures = dict[str, dict[str, float]]
Words = dict[str, dict[str, float | str]]  # of what is no figure alone

WARM_UP = 20  # calls


def milliseconds(seconds: list[float]) -> dict[str, float]:
    """p50, p99 and mean, in ms."""
    p50, p99 = np.percentile(seconds, (50, 99)) * 1e3
    return {"p50 ms": float(p50), "p99 ms": float(p99), "mean ms": float(np.mean(seconds) * 1e3)}


def timed(call: Callable[[], object], count: int) -> dict[str, float]:
    """Times of `count` calls."""
    for _ in range(min(WARM_UP, count)):
        call()
    seconds = []
    for _ in range(count):
        before = perf_counter()
        call()
        seconds.append(perf_counter() - before)
    return milliseconds(seconds)


def each(calls: list[Callable[[], object]]) -> dict[str, float]:
    """Times of one call each, the first ones not counted."""
    seconds = []
    for call in calls:
        before = perf_counter()
        call()
        seconds.append(perf_counter() - before)
    return milliseconds(seconds[min(WARM_UP, len(seconds) // 2) :])


@dataclass
class Stalls:
    """What this machine let a thread wait beyond the pauses that it asked for: at most, and in all, with these, s."""

    worst: float = 0.0
    beyond: float = 0.0
    passed: float = 1e-9

    @property
    def share(self) -> float:
        """Of the time that passed."""
        return self.beyond / self.passed


@contextmanager
def stalls(pause: float) -> Iterator[Stalls]:
    """Of a thread that asks for such pauses [s]."""
    found, done = Stalls(), threading.Event()

    def watch() -> None:
        while not done.is_set():
            before = time.monotonic()
            time.sleep(pause)
            passed = time.monotonic() - before
            found.worst = max(found.worst, passed - pause)
            found.beyond, found.passed = found.beyond + passed - pause, found.passed + passed

    thread = threading.Thread(target=watch, daemon=True)
    thread.start()
    try:
        yield found
    finally:
        done.set()
        thread.join()

"""Time calls in one process: medians and percentiles of many calls, after a warm-up."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from time import perf_counter

import numpy as np
import psutil

Figures = dict[str, dict[str, float]]  # numbers by row and column
Words = dict[str, dict[str, float | str]]  # the same, with texts

WARM_UP = 20  # calls


def milliseconds(seconds: Sequence[float]) -> dict[str, float]:
    """Return p50, p99 and mean in ms."""
    p50, p99 = np.percentile(seconds, (50, 99)) * 1e3
    return {"p50 ms": float(p50), "p99 ms": float(p99), "mean ms": float(np.mean(seconds) * 1e3)}


def timed(call: Callable[[], object], count: int) -> dict[str, float]:
    """Return the times of `count` calls of one function, after a warm-up."""
    return timed_each([call] * (count + min(WARM_UP, count)))


def timed_each(calls: Sequence[Callable[[], object]]) -> dict[str, float]:
    """Return the times of one call of each function. The first calls are a warm-up and do not count."""
    seconds = []
    for call in calls:
        before = perf_counter()
        call()
        seconds.append(perf_counter() - before)
    return milliseconds(seconds[min(WARM_UP, len(seconds) // 2) :])


def processor_time(process: psutil.Process) -> float:
    """Return the processor time of a process so far [s]."""
    return float(sum(process.cpu_times()[:2]))


def processor_times(launcher: int) -> dict[str, float]:
    """Return the processor time [s] of a launcher and of the processes of its run that live, by their names."""
    times: dict[str, float] = {}
    with suppress(psutil.NoSuchProcess):
        top = psutil.Process(launcher)
        for process in (top, *top.children(recursive=True)):
            with suppress(psutil.Error, IndexError):  # it has just ended
                times["launcher" if process == top else process.cmdline()[-1]] = processor_time(process)
    return times


def spread_of(ratios: np.ndarray) -> dict[str, float]:
    """Return the median, the least and the largest of some ratios."""
    return {"ratio": float(np.median(ratios)), "ratio low": float(ratios.min()), "ratio high": float(ratios.max())}


@contextmanager
def repeated(call: Callable[[], object], seconds: float) -> Iterator[None]:
    """Call a function in a thread every `seconds` until the end of the block."""
    over = threading.Event()

    def loop() -> None:
        while not over.wait(seconds):
            call()

    thread = threading.Thread(target=loop, daemon=True)
    thread.start()
    try:
        yield
    finally:
        over.set()
        thread.join()


@dataclass
class Stalls:
    """The time for which this machine let a thread wait beyond the pauses that it asked for.

    Attributes:
        worst: the longest time beyond one pause, s.
        beyond: the sum over all pauses, s.
        passed: the time in all, s.
    """

    worst: float = 0.0
    beyond: float = 0.0
    passed: float = 1e-9

    @property
    def share(self) -> float:
        """The share of the time that the thread waited too long."""
        return self.beyond / self.passed


@contextmanager
def stalls(pause: float) -> Iterator[Stalls]:
    """Measure the stalls of a thread that asks for pauses of `pause` s, until the end of the block."""
    measured = Stalls()

    def sleep() -> None:
        before = time.monotonic()
        time.sleep(pause)
        passed = time.monotonic() - before
        measured.worst = max(measured.worst, passed - pause)
        measured.beyond, measured.passed = measured.beyond + passed - pause, measured.passed + passed

    with repeated(sleep, 0.0):
        yield measured

"""Figures of a stream of numbers in bounded memory: count, mean, deviation, extremes, percentiles to half a percent.

A `QuantileSketch` has bins whose edges grow by `RATIO`. A percentile is the middle of the bin that holds the value of
that rank, so it is wrong by at most `RESOLUTION` of itself, whatever the distribution and however long the stream.
"""

from __future__ import annotations

import math
from array import array
from collections.abc import Iterable
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

RATIO = 1.01  # of a bin's edges
RESOLUTION = 0.005  # largest relative error of a percentile
TINY = 1e-9  # values closer to zero than this are zero
HUGE = 1e15  # no second, metre or count of ours is as large, and the square of none may overflow a sum
BATCH = 1024  # values sorted into bins at once

_PER_E = 1.0 / math.log(RATIO)  # bins per factor e
_SHIFT = 1.0 - math.log(TINY) * _PER_E  # so that bins count from 1, upwards of TINY


def _middle(place: int) -> float:
    """The value that stands for all of a bin; bins of negative values have negative numbers."""
    if place == 0:
        return 0.0
    return math.copysign(math.exp((abs(place) + 0.5 - _SHIFT) / _PER_E), place)


@dataclass
class QuantileSketch:
    """At most some 3,000 bins for values over twelve decades; those that are no numbers, or as good as infinite, are
    only counted apart.

    Values wait until `BATCH` of them can be sorted into bins at once, several times as fast as one by one. Looking at
    the figures does not change when that is: so sums come out the same, however often somebody looks.
    """

    count: int = 0
    total: float = 0.0
    squares: float = 0.0
    low: float = math.inf
    high: float = -math.inf
    strange: int = 0  # as good as infinite, or no numbers
    bins: dict[int, int] = field(default_factory=dict)
    waiting: array[float] = field(default_factory=lambda: array("d"))

    def add(self, value: float) -> None:
        waiting = self.waiting
        waiting.append(value)
        if len(waiting) >= BATCH:
            self._sort()

    def settled(self) -> QuantileSketch:
        """A copy with nothing waiting."""
        copy = replace(self, bins=self.bins.copy(), waiting=self.waiting[:])
        copy._sort()
        return copy

    def _sort(self) -> None:
        given, self.waiting = np.asarray(self.waiting), array("d")
        self.take(given)

    def take(self, given: NDArray[np.float64]) -> None:
        """Sort values (n,) into bins at once."""
        values = given[np.abs(given) < HUGE]  # of NaN, too, this is false
        self.strange += len(given) - len(values)
        if not len(values):
            return
        self.count += len(values)
        self.total += float(values.sum())
        self.squares += float(values @ values)
        self.low = min(self.low, float(values.min()))
        self.high = max(self.high, float(values.max()))
        sizes = np.abs(values)
        places = np.floor(np.log(np.maximum(sizes, TINY)) * _PER_E + _SHIFT) * np.sign(values) * (sizes > TINY)
        found, counts = np.unique(places.astype(np.int64), return_counts=True)
        for place, count in zip(found.tolist(), counts.tolist(), strict=True):
            self.bins[place] = self.bins.get(place, 0) + count

    @property
    def mean(self) -> float:
        return self.total / self.count

    @property
    def std(self) -> float:
        return math.sqrt(max(0.0, self.squares / self.count - self.mean**2))

    def percentile(self, percent: float) -> float:
        """The value below or at which `percent` of the values lie (the inverse of the empirical distribution).

        As `mean`, `std` and `bars`: of the values that are settled; `merged` settles.
        """
        rank = max(1, math.ceil(percent / 100.0 * self.count))
        seen = 0
        for place in sorted(self.bins):
            seen += self.bins[place]
            if seen >= rank:
                return min(max(_middle(place), self.low), self.high)
        raise ValueError("nothing was measured")

    def bars(self, ratio: float = 1.25) -> list[tuple[float, float, int]]:
        """Coarser bins for a picture: (from, to, count), each about `ratio` wide, empty ones between included.

        Only positive values; those below `TINY` are in none.
        """
        width = max(1, round(math.log(ratio) * _PER_E))
        counts: dict[int, int] = {}
        for place, count in self.bins.items():
            if place > 0:
                counts[place // width] = counts.get(place // width, 0) + count
        if not counts:
            return []

        def edge(bar: int) -> float:
            return math.exp((bar * width - _SHIFT) / _PER_E)

        return [(edge(bar), edge(bar + 1), counts.get(bar, 0)) for bar in range(min(counts), max(counts) + 1)]


def merged(parts: Iterable[QuantileSketch]) -> QuantileSketch:
    """All values of the parts. The sums come out the same whenever the parts come in the same order."""
    parts = [part.settled() for part in parts]
    bins: dict[int, int] = {}
    for part in parts:
        for place, count in part.bins.items():
            bins[place] = bins.get(place, 0) + count
    return QuantileSketch(
        count=sum(part.count for part in parts),
        total=math.fsum(part.total for part in parts),
        squares=math.fsum(part.squares for part in parts),
        low=min((part.low for part in parts), default=math.inf),
        high=max((part.high for part in parts), default=-math.inf),
        strange=sum(part.strange for part in parts),
        bins=bins,
    )


def spread(*parts: QuantileSketch) -> dict[str, float] | None:
    """Mean, standard deviation, median and 99th percentile of the values; None if there is none."""
    values = merged(parts)
    if not values.count:
        return None
    return {"mean": values.mean, "std": values.std, "p50": values.percentile(50), "p99": values.percentile(99)}


def summary(*parts: QuantileSketch) -> dict[str, float] | None:
    """As `spread`, with how many values there are, the extremes and the 90th percentile."""
    values = merged(parts)
    if not values.count:
        return None
    return {
        "count": values.count,
        "mean": values.mean,
        "std": values.std,
        "min": values.low,
        "p50": values.percentile(50),
        "p90": values.percentile(90),
        "p99": values.percentile(99),
        "max": values.high,
    }

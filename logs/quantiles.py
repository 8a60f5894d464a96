"""Summarize a stream of numbers in bounded memory: count, mean, standard deviation, extremes, percentiles.

A `QuantileSketch` has logarithmic bins, as DDSketch does (Masson et al., VLDB 2019). A percentile is the middle of the
bin that holds the value of that rank, so its relative error is at most `RESOLUTION` for every distribution.

Why not the `ddsketch` package: it adds one value in 2.9 µs, this module in 0.46 µs, because it sorts `BATCH` values at
once. A message has about five values, and `analyse` reads 150,000 messages a second.
"""

from __future__ import annotations

import math
from array import array
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

Moments = tuple[int, float, float]  # count, sum, and sum of the squared deviations from the mean

RATIO = 1.01  # of the edges of a bin
RESOLUTION = 0.005  # largest relative error of a percentile
TINY = 1e-9  # a smaller absolute value counts as zero
HUGE = 1e15  # a larger absolute value counts as not finite: its squared deviation could overflow
BAR = 1.25  # ratio of the edges of a bar in a chart, about
BATCH = 1024  # values sorted into bins at once

_PER_E = 1.0 / math.log(RATIO)  # bins per factor e
_SHIFT = 1.0 - math.log(TINY) * _PER_E  # so that the bin above TINY has number 1


def _middle(place: int) -> float:
    """Return the middle of a bin; bins of negative values have negative numbers."""
    if place == 0:
        return 0.0
    return math.copysign(math.exp((abs(place) + 0.5 - _SHIFT) / _PER_E), place)


def _moments(values: NDArray[np.float64]) -> Moments:
    """Return the moments of values, at least one."""
    off = values - values.mean()
    return len(values), float(values.sum()), float(off @ off)


def _joined(parts: Sequence[Moments]) -> Moments:
    """Return the moments of all values from those of the parts."""
    count, total = sum(part[0] for part in parts), math.fsum(part[1] for part in parts)
    apart = (size * (own / size - total / count) ** 2 for size, own, _ in parts if size)
    return count, total, math.fsum([*(part[2] for part in parts), *apart])


@dataclass
class QuantileSketch:
    """A histogram with logarithmic bins: about 3,000 bins for values over twelve decades.

    Values wait in `pending` until there are `BATCH` of them. Reading the figures never changes when they are sorted, so
    the floating-point sums do not depend on how often a program reads them.

    Attributes:
        total: sum of the values.
        scatter: sum of their squared deviations from the mean. Sums of squares would lose the digits of a small
            deviation (Chan, Golub and LeVeque 1983).
        low, high: smallest and largest value.
        not_finite: number of values that are NaN or above `HUGE`; no other attribute includes them.
        bins: count by number of the bin.
    """

    count: int = 0
    total: float = 0.0
    scatter: float = 0.0
    low: float = math.inf
    high: float = -math.inf
    not_finite: int = 0
    bins: Counter[int] = field(default_factory=Counter)
    pending: array[float] = field(default_factory=lambda: array("d"))

    def add(self, value: float) -> None:
        pending = self.pending
        pending.append(value)
        if len(pending) >= BATCH:
            self._flush()

    def flushed(self) -> QuantileSketch:
        """Return a copy without pending values; of a sketch without any value, the sketch itself."""
        if not self.pending and not self.bins:
            return self
        copy = replace(self, bins=self.bins.copy(), pending=self.pending[:])
        copy._flush()
        return copy

    def _flush(self) -> None:
        """Sort the pending values into bins."""
        values, self.pending = np.asarray(self.pending), array("d")
        finite = np.abs(values) < HUGE  # False for NaN
        self.not_finite += len(values) - int(finite.sum())
        values = values[finite]
        if not len(values):
            return
        batch = _moments(values)
        self.count, self.total, self.scatter = _joined([(self.count, self.total, self.scatter), batch])
        self.low = min(self.low, float(values.min()))
        self.high = max(self.high, float(values.max()))
        sizes = np.abs(values)
        places = np.floor(np.log(np.maximum(sizes, TINY)) * _PER_E + _SHIFT) * np.sign(values) * (sizes > TINY)
        numbers, counts = np.unique(places.astype(np.int64), return_counts=True)
        self.bins.update(dict(zip(numbers.tolist(), counts.tolist(), strict=True)))

    @property
    def mean(self) -> float:
        return self.total / self.count

    @property
    def std(self) -> float:
        return math.sqrt(self.scatter / self.count)

    def percentile(self, percent: float) -> float:
        """Return the inverse of the empirical distribution function at `percent`.

        Like `mean`, `std` and `bars`, it ignores pending values; call `merged` or `flushed` first.

        Raises:
            ValueError: the sketch is empty.
        """
        rank = max(1, math.ceil(percent / 100.0 * self.count))
        cumulative = 0
        for place in sorted(self.bins):
            cumulative += self.bins[place]
            if cumulative >= rank:
                return min(max(_middle(place), self.low), self.high)
        raise ValueError("the sketch has no value")

    def bars(self) -> list[tuple[float, float, int]]:
        """Return coarser bins (from, to, count) of the positive values, about `BAR` wide, also the empty ones."""
        width = round(math.log(BAR) * _PER_E)
        counts: Counter[int] = Counter()
        for place, count in self.bins.items():
            if place > 0:
                counts[place // width] += count
        if not counts:
            return []

        def edge(bar: int) -> float:
            return math.exp((bar * width - _SHIFT) / _PER_E)

        return [(edge(bar), edge(bar + 1), counts[bar]) for bar in range(min(counts), max(counts) + 1)]


def merged(parts: Iterable[QuantileSketch]) -> QuantileSketch:
    """Merge sketches. The floating-point sums depend only on the order of the parts."""
    parts = [part.flushed() for part in parts]
    bins: Counter[int] = Counter()
    for part in parts:
        bins.update(part.bins)
    count, total, scatter = _joined([(part.count, part.total, part.scatter) for part in parts])
    return QuantileSketch(
        count=count,
        total=total,
        scatter=scatter,
        low=min((part.low for part in parts), default=math.inf),
        high=max((part.high for part in parts), default=-math.inf),
        not_finite=sum(part.not_finite for part in parts),
        bins=bins,
    )


def summary(*parts: QuantileSketch) -> dict[str, float] | None:
    """Return count, mean, standard deviation, extremes and percentiles; None without a value."""
    values = merged(parts)
    if not values.count:
        return None
    return {
        "count": values.count,
        "mean": values.mean,
        "std": values.std,
        "min": values.low,
        **{f"p{percent}": values.percentile(percent) for percent in (50, 90, 99)},
        "max": values.high,
    }


def spread(*parts: QuantileSketch) -> dict[str, float] | None:
    """Return mean, standard deviation, median and 99th percentile; None without a value."""
    whole = summary(*parts)
    return whole and {name: whole[name] for name in ("mean", "std", "p50", "p99")}

"""Intervals of figures over seeds and episodes: the hierarchical bootstrap (seed first, then its episodes).

Seeds are few, and an interval over few seeds is a rough one: the table says how many there are, the figures show each.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]

DRAWS = 4000
CONFIDENCE = 0.95


@dataclass(frozen=True)
class Estimate:
    """A figure with its interval at 95 %, and the seeds' own figures."""

    value: float
    low: float
    high: float
    seeds: tuple[float, ...]


def ratio(above: Sequence[ArrayLike], below: Sequence[ArrayLike], seed: int = 0) -> Estimate:
    """Mean over seeds of Σ above / Σ below over a seed's episodes, each given as one array (episodes,) a seed.

    With `below` all ones: the mean over episodes. Each draw takes as many seeds as there are, and of each as many
    episodes as it has, with replacement.

    Raises:
        ValueError: no seed, or one without an episode.
    """
    pairs = [(np.asarray(a, float), np.asarray(b, float)) for a, b in zip(above, below, strict=True)]
    if not pairs or not all(len(a) for a, _ in pairs):
        raise ValueError("an interval needs at least one episode of each seed")
    rng = np.random.default_rng(seed)
    own = np.array([a.sum() / b.sum() for a, b in pairs])
    again = np.stack([_resampled(a, b, rng) for a, b in pairs])  # (seeds, DRAWS)
    shape = len(pairs), DRAWS
    # any of a seed's resamples is as good as another: so a seed that is drawn twice is resampled twice
    drawn = again[rng.integers(len(pairs), size=shape), rng.integers(DRAWS, size=shape)].mean(axis=0)
    tail = 100.0 * (1.0 - CONFIDENCE) / 2.0
    low, high = np.percentile(drawn, (tail, 100.0 - tail))
    return Estimate(float(own.mean()), float(low), float(high), tuple(map(float, own)))


def mean(values: Sequence[ArrayLike], seed: int = 0) -> Estimate:
    """Of a figure per episode, one array a seed."""
    return ratio(values, [np.ones(len(np.asarray(v))) for v in values], seed)


def _resampled(above: Array, below: Array, rng: np.random.Generator) -> Array:
    """Σ above / Σ below of `DRAWS` resamples of the episodes."""
    counts = rng.multinomial(len(above), np.full(len(above), 1.0 / len(above)), size=DRAWS)
    return np.asarray((counts @ above) / (counts @ below))

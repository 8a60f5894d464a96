"""Confidence intervals over seeds and episodes by the hierarchical bootstrap: resample seeds, then their episodes.

`scipy.stats.bootstrap` resamples one level only, which would treat the episodes of one trained policy as independent.
With few seeds the interval is rough, so the table states the number of seeds and the plots show each of them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from brakeline.logs.proportion_intervals import clopper_pearson
from brakeline.messaging.robot import Array

RESAMPLES = 4000
CONFIDENCE = 0.95


@dataclass(frozen=True)
class MeanEstimate:
    """An estimate with its 95 % confidence interval, and the value of each seed."""

    value: float
    low: float
    high: float
    seeds: tuple[float, ...]


def ratio(above: Sequence[ArrayLike], below: Sequence[ArrayLike], seed: int = 0) -> MeanEstimate:
    """Estimate the mean over seeds of Σ above / Σ below, summed over the episodes of a seed.

    Each resample draws, with replacement, as many seeds as there are, and for each as many episodes as it has.

    above, below: one array (episodes,) per seed. seed: of the resampling.

    Raises:
        ValueError: there is no seed, or a seed has no episode.
    """
    pairs = [(np.asarray(a, float), np.asarray(b, float)) for a, b in zip(above, below, strict=True)]
    if not pairs or not all(len(a) for a, _ in pairs):
        raise ValueError("an interval needs at least one episode of each seed")
    rng = np.random.default_rng(seed)
    per_seed = np.array([a.sum() / b.sum() for a, b in pairs])
    resampled = np.stack([_resampled(a, b, rng) for a, b in pairs])  # (seeds, RESAMPLES)
    shape = len(pairs), RESAMPLES
    # Draw an independent resample of the episodes for each seed, also if a seed is drawn twice.
    means = resampled[rng.integers(len(pairs), size=shape), rng.integers(RESAMPLES, size=shape)].mean(axis=0)
    tail = 100.0 * (1.0 - CONFIDENCE) / 2.0
    low, high = np.percentile(means, (tail, 100.0 - tail))
    return MeanEstimate(float(per_seed.mean()), float(low), float(high), tuple(map(float, per_seed)))


def mean(values: Sequence[ArrayLike], seed: int = 0) -> MeanEstimate:
    """Estimate the mean over seeds and episodes of `values`, one array (episodes,) per seed."""
    return ratio(values, [np.ones(len(np.asarray(v))) for v in values], seed)


def rate(happened: Sequence[ArrayLike]) -> MeanEstimate:
    """Estimate the probability of an event from 0 and 1, one array (episodes,) per seed.

    If it never or always happened, all resamples are alike: then the interval is the exact one of Clopper and Pearson,
    which takes all episodes as independent.
    """
    estimate, episodes = mean(happened), sum(len(np.asarray(each)) for each in happened)
    if 0.0 < estimate.value < 1.0:
        return estimate
    low, high = clopper_pearson(round(estimate.value * episodes), episodes) or (0.0, 1.0)
    return replace(estimate, low=low, high=high)


def _resampled(above: Array, below: Array, rng: np.random.Generator) -> Array:
    """Return Σ above / Σ below (RESAMPLES,) for resampled episodes."""
    counts = rng.multinomial(len(above), np.full(len(above), 1.0 / len(above)), size=RESAMPLES)
    return np.asarray((counts @ above) / (counts @ below))

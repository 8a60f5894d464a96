"""Confidence intervals over seeds and episodes by the bootstrap: resample seeds, and their episodes.

Where all seeds drove the same episodes (crossed), a resample draws the same episodes for each seed, because a room that
is hard for one policy is hard for the others. Otherwise each seed has a draw of its own (hierarchical).

`scipy.stats.bootstrap` resamples one level only, which would treat the episodes of one trained policy as independent.
With few seeds the interval is rough, so the table states the number of seeds and the plots show each of them.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any

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


def ratio(
    above: Sequence[ArrayLike], below: Sequence[ArrayLike], seed: int = 0, *, crossed: bool = False
) -> MeanEstimate:
    """Estimate the mean over seeds of Σ above / Σ below, summed over the episodes of a seed.

    Each resample draws, with replacement, as many seeds as there are, and as many episodes as a seed has.

    Args:
        above: one array (episodes,) per seed.
        below: likewise.
        seed: of the resampling.
        crossed: episode i is the same for each seed.

    Raises:
        ValueError: there is no seed, a seed has no episode, or crossed seeds have other numbers of episodes.
    """
    pairs = [(np.asarray(a, float), np.asarray(b, float)) for a, b in zip(above, below, strict=True)]
    if not pairs or not all(len(a) for a, _ in pairs):
        raise ValueError("an interval needs at least one episode of each seed: train for more steps")
    rng = np.random.default_rng(seed)
    per_seed = np.array([a.sum() / b.sum() for a, b in pairs])
    if crossed and len({len(a) for a, _ in pairs}) > 1:
        raise ValueError("seeds with the same episodes have the same number of them")
    # how often each episode was drawn
    counts = [_drawn_for_all(len(a), seed, rng) if crossed else _drawn(len(a), rng, RESAMPLES) for a, _ in pairs]
    resampled = np.stack([(drawn @ a) / (drawn @ b) for (a, b), drawn in zip(pairs, counts, strict=True)])
    shape = len(pairs), RESAMPLES  # of the seeds drawn
    # Without common episodes, draw them independently for each seed, also if a seed is drawn twice.
    columns = np.arange(RESAMPLES) if crossed else rng.integers(RESAMPLES, size=shape)
    means = resampled[rng.integers(len(pairs), size=shape), columns].mean(axis=0)
    tail = 100.0 * (1.0 - CONFIDENCE) / 2.0
    low, high = np.percentile(means, (tail, 100.0 - tail))
    return MeanEstimate(float(per_seed.mean()), float(low), float(high), tuple(map(float, per_seed)))


def mean(values: Sequence[ArrayLike], seed: int = 0, *, crossed: bool = False) -> MeanEstimate:
    """Estimate the mean over seeds and episodes of `values`, one array (episodes,) per seed; see `ratio`."""
    return ratio(values, [np.ones(len(np.asarray(v))) for v in values], seed, crossed=crossed)


def rate(happened: Sequence[ArrayLike], *, crossed: bool = False) -> MeanEstimate:
    """Estimate the probability of an event from 0 and 1, one array (episodes,) per seed; see `share`."""
    return share(happened, [np.ones(len(np.asarray(of_seed))) for of_seed in happened], crossed=crossed)


def share(hits: Sequence[ArrayLike], of: Sequence[ArrayLike], *, crossed: bool = False) -> MeanEstimate:
    """Estimate the share of hits in steps, counted by episode, one array (episodes,) per seed each; see `ratio`.

    If all steps or none are hits, all resamples are alike: then each episode counts as one trial, and the interval is
    the exact one of Clopper and Pearson, which takes all episodes as independent.
    """
    estimate, episodes = ratio(hits, of, crossed=crossed), sum(len(np.asarray(of_seed)) for of_seed in hits)
    if 0.0 < estimate.value < 1.0:
        return estimate
    low, high = clopper_pearson(round(estimate.value * episodes), episodes) or (0.0, 1.0)
    return replace(estimate, low=low, high=high)


def _drawn(episodes: int, rng: np.random.Generator, resamples: int) -> Array:
    """Return how often each episode is drawn, (resamples, episodes)."""
    return np.asarray(rng.multinomial(episodes, np.full(episodes, 1.0 / episodes), size=resamples), float)


def _drawn_for_all(episodes: int, seed: int, rng: np.random.Generator) -> Array:
    """Return the first draw of `rng`, which was made from `seed`: a table draws the same one hundreds of times."""
    drawn, rng.bit_generator.state = _first_draw(episodes, seed, RESAMPLES)
    return drawn


@lru_cache(maxsize=4)
def _first_draw(episodes: int, seed: int, resamples: int) -> tuple[Array, Mapping[str, Any]]:
    """Return the first draw from a seed, and the generator's state after it."""
    rng = np.random.default_rng(seed)
    return _drawn(episodes, rng, resamples), rng.bit_generator.state

"""Compute confidence intervals of rates, at 95 % unless another confidence is given.

Why not `scipy.stats.binomtest(...).proportion_ci()`: it takes 5 ms for each interval and importing `scipy.stats` takes
up to 3 s; the inverse beta function of `scipy.special`, which it uses too, takes 5 µs. The tests compare both.
"""

from __future__ import annotations

import numpy as np

Interval = tuple[float, float]

CONFIDENCE = 0.95


def clopper_pearson(count: int, of: int, confidence: float = CONFIDENCE) -> Interval | None:
    """Return the exact interval of a probability, after `count` successes in `of` independent trials.

    Its coverage is at least the confidence; with 0 of n, the upper end at 95 % is 1 - 0.025^(1/n). None without a
    trial.
    """
    if of <= 0:
        return None
    return _beta_interval(count, of, confidence)


def _beta_interval(count: float, of: float, confidence: float) -> Interval:
    """Return the interval of Clopper and Pearson, also for numbers that are not whole."""
    from scipy.special import betaincinv  # imported late: a third of a second that a launcher needs only at its end

    tail = (1.0 - confidence) / 2.0
    low = 0.0 if count == 0 else float(betaincinv(count, of - count + 1, tail))
    high = 1.0 if count == of else float(betaincinv(count + 1, of - count, 1.0 - tail))
    return low, high


def poisson(count: int, of: int) -> Interval | None:
    """Return Garwood's exact interval of the mean number of events per trial, after `count` events in `of` trials.

    One trial may have several events. None without a trial.
    """
    if of <= 0:
        return None
    from scipy.special import gammaincinv

    tail = (1.0 - CONFIDENCE) / 2.0
    low = 0.0 if count == 0 else float(gammaincinv(count, tail))
    return low / of, float(gammaincinv(count + 1, 1.0 - tail)) / of


class ClusteredProportion:
    """Interval of a fraction of steps when the steps of one episode are correlated.

    With x_e of n_e steps in episode e = 1..E, the ratio estimator r = Σx / Σn has approximately the variance
    v = E/(E-1) Σ(x_e - r n_e)² / (Σn)². Episodes are independent; steps are not. As many independent steps as have this
    variance, r(1-r)/v, take the place of Σn in the interval of Clopper and Pearson (Korn and Graubard, "Confidence
    intervals for proportions with small expected number of positive counts estimated from survey data", 1998). Because
    few episodes tell v roughly, this number is reduced by the square of a ratio of quantiles of Student's t.

    If r is 0 or 1, v is 0 however few episodes there are. Then each episode counts as one trial, and the interval is
    the exact one of 0 or E successes in E trials.
    """

    def __init__(self) -> None:
        self._sums = np.zeros(6, dtype=int)  # of 1, x, n, x², x n and n² over the episodes

    def add(self, hits: int, trials: int) -> None:
        self._sums += (1, hits, trials, hits * hits, hits * trials, trials * trials)

    def join(self, other: ClusteredProportion) -> None:
        """Add all episodes of another."""
        self._sums += other._sums

    def interval(self) -> Interval | None:
        """Return the interval, within [0, 1]; None for fewer than two episodes."""
        clusters, hits, trials, xx, xn, nn = self._sums.tolist()
        if clusters < 2 or not trials:
            return None
        if hits in (0, trials):
            return clopper_pearson(clusters if hits else 0, clusters)
        rate = hits / trials
        variance = clusters / (clusters - 1) * max(0.0, xx - 2.0 * rate * xn + rate * rate * nn) / trials**2
        return _by_variance(rate, variance, clusters, trials)


def _by_variance(rate: float, variance: float, clusters: int, trials: int) -> Interval:
    """Return the interval of Korn and Graubard for a rate of `trials` steps in `clusters` episodes."""
    from scipy.special import stdtrit  # imported late, as above

    of = float(trials)
    if variance > 0.0:
        quantile = 1.0 - (1.0 - CONFIDENCE) / 2.0
        reduction = float(stdtrit(trials - 1, quantile) / stdtrit(clusters - 1, quantile)) ** 2
        of = min(of, rate * (1.0 - rate) / variance * reduction)
    return _beta_interval(rate * of, of, CONFIDENCE)

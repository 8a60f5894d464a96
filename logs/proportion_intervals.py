"""How far a rate can be trusted: intervals at 95 % confidence."""

from __future__ import annotations

import math

Interval = tuple[float, float]

CONFIDENCE = 0.95
_Z = 1.959963984540054  # of the normal distribution, for CONFIDENCE


def clopper_pearson(count: int, of: int) -> Interval | None:
    """The exact interval of a probability that showed itself `count` times in `of` independent trials.

    Never shorter than it claims: with 0 of n, the upper end is 1 - 0.025^(1/n). None without a trial.
    """
    if of <= 0:
        return None
    from scipy.special import betaincinv  # a third of a second: a launcher needs it at its end

    tail = (1.0 - CONFIDENCE) / 2.0
    low = 0.0 if count == 0 else float(betaincinv(count, of - count + 1, tail))
    high = 1.0 if count == of else float(betaincinv(count + 1, of - count, 1.0 - tail))
    return low, high


def poisson(count: int, of: int) -> Interval | None:
    """The exact interval (Garwood's) of how often something happens in a trial, that happened `count` times in `of`
    trials, and may happen several times in one. None without a trial."""
    if of <= 0:
        return None
    from scipy.special import gammaincinv

    tail = (1.0 - CONFIDENCE) / 2.0
    low = 0.0 if count == 0 else float(gammaincinv(count, tail))
    return low / of, float(gammaincinv(count + 1, 1.0 - tail)) / of


class ClusteredProportion:
    """The interval of a share of steps, when the steps of one episode resemble each other.

    With x_e of n_e steps in episode e, r = Σx / Σn has about the variance E/(E-1) Σ(x_e - r n_e)² / (Σn)²: that of a
    ratio of sums over episodes, which are independent where steps are not. Three sums are enough.
    """

    def __init__(self) -> None:
        self.clusters = self.hits = self.trials = 0
        self.xx = self.xn = self.nn = 0

    def add(self, hits: int, trials: int) -> None:
        """Take an episode."""
        self.clusters += 1
        self.hits += hits
        self.trials += trials
        self.xx += hits * hits
        self.xn += hits * trials
        self.nn += trials * trials

    def join(self, other: ClusteredProportion) -> None:
        """Take all episodes of another."""
        for name in ("clusters", "hits", "trials", "xx", "xn", "nn"):
            setattr(self, name, getattr(self, name) + getattr(other, name))

    def interval(self) -> Interval | None:
        """None with fewer than two episodes; within [0, 1]."""
        if self.clusters < 2 or not self.trials:
            return None
        rate = self.hits / self.trials
        squares = max(0.0, self.xx - 2.0 * rate * self.xn + rate * rate * self.nn)
        half = _Z * math.sqrt(squares * self.clusters / (self.clusters - 1)) / self.trials
        return max(0.0, rate - half), min(1.0, rate + half)

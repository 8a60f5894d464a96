"""The factors that scale the shape of the sets, from the scores of calibrating windows (docs/method.md §14)."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from brakeline.safety.model.driving_kinds import JUMPING, START

MOST_STARTS = 0.25  # of the windows: with more, what is left would not calibrate the sets of a robot that drives on
Array = NDArray[np.float64]
Mask = NDArray[np.bool_]


@dataclass(frozen=True)
class SetFactors:
    """Factors on the shape, for each part of a plan's sets.

    Attributes:
        plan: on positions, coordinates that a limit needs and chord deviations.
        first: on the other coordinates after one period.
        start: further factor on all of them within a plan's length of an episode's start, at least 1.
    """

    plan: float
    first: float
    start: float

    @staticmethod
    def of(plan: Array, first: Array, kinds: dict[str, Mask], outside: float, same: bool = False) -> SetFactors:
        """Return the least factors that leave at most a share `outside` of the windows of every kind outside.

        Inputs that jump in most periods excite motion that no state shows, such as a quadrotor's attitude. For all
        driving, `plan` would have to be several times as large. No plan of the filter jumps like this, so only `first`
        covers it. Many lost rows cut a recording into pieces of a few plans' lengths. Then most windows are starts,
        although the robot drove on, and all of them decide about all sets.

        Args:
            plan (T,), first (T,): scores of the windows, for both parts.
            kinds: the windows (T,) of each kind of driving.
            outside: the share.
            same: whether both parts have the same factor.
        """
        begun = ~kinds[START] | (kinds[START].mean() > MOST_STARTS)
        others = [np.ones(len(plan), dtype=bool), *(kind for name, kind in kinds.items() if name != START)]
        for_plan = max(_quantile(plan[kind & begun & ~kinds[JUMPING]], outside) for kind in others)
        for_first = max(_quantile(first[kind & begun], outside) for kind in others)
        if same:
            for_plan = for_first = max(for_plan, for_first)
        at_start = _quantile(plan[~begun], outside) / for_plan, _quantile(first[~begun], outside) / for_first
        return SetFactors(for_plan, for_first, max(1.0, *at_start))

    def shares(self, plan: Array, first: Array, kinds: dict[str, Mask]) -> Array:
        """Return how much of its sets each window used (T,), from its scores; above 1, it is outside."""
        with np.errstate(invalid="ignore"):
            both = np.maximum(plan / self.plan, first / self.first) / np.where(kinds[START], self.start, 1.0)
        return np.where(np.isnan(both), np.inf, both)


def _quantile(scores: Array, outside: float) -> float:
    """Return the ⌈(n + 1)(1 - outside)⌉-th of n scores, and the largest one if they are few; at least 1.

    A score that is no number counts as infinite.
    """
    if not len(scores):
        return 1.0
    scores = np.where(np.isnan(scores), np.inf, scores)
    return max(1.0, float(np.sort(scores)[min(math.ceil((len(scores) + 1) * (1.0 - outside)), len(scores)) - 1]))

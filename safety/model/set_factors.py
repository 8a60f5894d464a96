"""The factors that scale the shape of the sets, from the scores of calibrating windows (docs/method.md §14)."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

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
        plan (G,): on each position, each coordinate that a limit needs, and the chord deviations.
        first: on the other coordinates after one period.
        start: further factor on all of them within a plan's length of an episode's start, at least 1.
    """

    plan: Array
    first: float
    start: float

    @staticmethod
    def of(plan: Array, first: Array, kinds: dict[str, Mask], outside: float, same: bool = False) -> SetFactors:
        """Return factors that leave at most a share `outside` of the windows of every kind outside.

        Over all windows, one factor holds for all coordinates: of a share `outside`, any coordinate may leave. A kind
        of driving with few windows may need much larger sets for a few events, such as errors of the height in fast
        flight. Then only the coordinates that leave get larger factors.

        Inputs that jump in most periods excite motion that no state shows, such as a quadrotor's attitude. For all
        driving, `plan` would have to be several times as large. No plan of the filter jumps like this, so only `first`
        covers it. Many lost rows cut a recording into pieces of a few plans' lengths. Then most windows are starts,
        although the robot drove on, and all of them decide about all sets.

        Args:
            plan (G, T), first (T,): scores of the windows, for both parts.
            kinds: the windows (T,) of each kind of driving.
            outside: the share.
            same: whether all parts have the same factor.
        """
        begun = ~kinds[START] | (kinds[START].mean() > MOST_STARTS)
        steady = begun & ~kinds[JUMPING]
        others = [kind for name, kind in kinds.items() if name != START]
        for_all = _quantile(plan[:, steady].max(0), outside)
        for_plan = np.max([_of_each(plan[:, kind & steady], outside, for_all) for kind in others], axis=0)
        for_first = max(_quantile(first[kind & begun], outside) for kind in (begun, *others))
        if same:
            for_first = max(float(for_plan.max()), for_first)
            for_plan = np.full(len(plan), for_first)
        factors = SetFactors(for_plan, for_first, 1.0)
        used = factors.shares(plan, np.zeros_like(first), kinds), first / for_first
        return replace(factors, start=max(1.0, *(_quantile(part[~begun], outside) for part in used)))

    def shares(self, plan: Array, first: Array, kinds: dict[str, Mask]) -> Array:
        """Return how much of its sets each window used (T,), from its scores; above 1, it is outside.

        plan (g, T): the scores of the first g coordinates.
        """
        with np.errstate(invalid="ignore"):
            most = (plan / self.plan[: len(plan), None]).max(0, initial=0.0)
            both = np.maximum(most, first / self.first) / np.where(kinds[START], self.start, 1.0)
        return np.where(np.isnan(both), np.inf, both)


def _of_each(scores: Array, outside: float, least: float) -> Array:
    """Return factors (G,), at least `least`, that leave at most a share `outside` of the windows outside.

    The windows outside are those with the largest scores. Each coordinate holds all others.

    scores (G, T): of each coordinate.
    """
    scores = np.where(np.isnan(scores), np.inf, scores)
    held = np.argsort(scores.max(0))[: _rank(scores.shape[1], outside)]
    return np.asarray(np.maximum(scores[:, held].max(1, initial=0.0), least))


def _rank(count: int, outside: float) -> int:
    """Return which of `count` scores, from the smallest on, bounds all but a share `outside` of new ones."""
    return min(math.ceil((count + 1) * (1.0 - outside)), count)


def _quantile(scores: Array, outside: float) -> float:
    """Return the ⌈(n + 1)(1 - outside)⌉-th of n scores, and the largest one if they are few; at least 1.

    A score that is no number counts as infinite.
    """
    if not len(scores):
        return 1.0
    scores = np.where(np.isnan(scores), np.inf, scores)
    return max(1.0, float(np.sort(scores)[_rank(len(scores), outside) - 1]))

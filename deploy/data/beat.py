"""Find the beat of a log: the time step at which a controller changes its inputs, also if it often holds them."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from brakeline.deploy.data.sources.source_table import Array

FEWEST_CHANGES = 10  # of the inputs: fewer show no beat
LEAST_COHERENCE, LEAST_SIGMAS = 0.5, 3.8  # of the times with a beat; for few times, standard deviations of chance
AS_COHERENT = 0.93  # a divisor of the beat is about as coherent as the beat: the longest step within this share counts
GRID = 1.002  # ratio of two steps that are compared
MOST_BEATS = 20  # longer times between changes show the beat less precisely
MOST_TIMES = 2000  # that are compared
NEAR = 0.25  # of a beat: how far from a multiple a time still counts
LONGEST = 10.0  # s: a longer beat is no controller's


@dataclass(frozen=True)
class Beat:
    """The finest common step of the changes of the inputs, and the evidence for it."""

    seconds: float
    share: float  # of the times between two changes that are near a multiple of it; half of them are by chance
    changes: int


def find_beat(between: Array, step: float) -> Beat | None:
    """Return the longest step of which the times d between two changes are multiples; None if there is none.

    The coherence of a step T is the mean of cos(2 pi d / T). It is 1 for exact multiples, 0 for random times, and
    late or rounded stamps lower it less for T than for the divisors of T.

    Args:
        between: (n,) times in s between two consecutive changes of any input.
        step: time in s between two samples of the inputs, which is how precisely the log shows a change.
    """
    between = between[between > 0.5 * step]
    if len(between) < FEWEST_CHANGES:
        return None
    times = np.sort(between)[:: math.ceil(len(between) / MOST_TIMES)]
    # The rows of a log are multiples of their own step, whenever the inputs change: it counts only if most do at once.
    first = (0.98 if np.median(times) < 1.5 * step else 1.4) * step
    longest = min(1.1 * float(np.median(times)), LONGEST)
    steps = first * GRID ** np.arange(math.ceil(math.log(max(longest / first, 1.0)) / math.log(GRID)) + 20)
    coherence = np.array([_coherence(times, one) for one in steps])
    best = float(coherence.max())
    if best < 0.0:
        return None
    last = int(np.flatnonzero(coherence >= AS_COHERENT * best)[-1])
    around = slice(max(last - 20, 0), last + 1)
    seconds = _refined(times, float(steps[around][coherence[around].argmax()]), step)
    away = np.abs(between / seconds - np.round(between / seconds))
    return Beat(seconds, float(np.mean((away <= NEAR) & (between > 0.5 * seconds))), len(between))


def _coherence(times: Array, step: float) -> float:
    """Return the coherence of a step, or -1 if chance explains it."""
    near = times[: int(np.searchsorted(times, MOST_BEATS * step))]
    if len(near) < FEWEST_CHANGES:
        return -1.0
    coherence = float(np.cos(2.0 * np.pi / step * near).mean())
    return coherence if coherence > max(LEAST_COHERENCE, LEAST_SIGMAS * math.sqrt(0.5 / len(near))) else -1.0


def _refined(times: Array, seconds: float, step: float) -> float:
    """Return the step that fits the times best (least squares), from a first guess.

    If a row is long beside the beat, the times are multiples of the row, and those near multiples of a guess confirm
    it. Then every time counts, the shortest ones first, because a wrong guess counts too many beats in the others.
    """
    if step < NEAR * seconds:
        multiples = np.round(times / seconds)
        near = (multiples >= 1.0) & (multiples <= MOST_BEATS) & (np.abs(times / seconds - multiples) <= NEAR)
        return float(times[near] @ multiples[near] / (multiples[near] @ multiples[near])) if near.any() else seconds
    for most in range(1, MOST_BEATS + 1):
        multiples = np.round(times / seconds)
        near = (multiples >= 1.0) & (multiples <= most)
        seconds = float(times[near] @ multiples[near] / (multiples[near] @ multiples[near])) if near.any() else seconds
    return seconds

"""How a robot answers to its inputs, as an aligned log shows it: what follows an input, how late and how fast."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from brakeline.deploy.data.aligned_log import AlignedLog
from brakeline.deploy.data.input_delay import estimate_delay
from brakeline.deploy.data.motion_check import FEWEST_SPANS, MAX_LAG, SPAN, agreement, same_gain
from brakeline.deploy.data.sources.quantity_names import COMMAND
from brakeline.deploy.data.sources.source_table import Array

FOLLOWS_CORRELATION = 0.6  # of an input with the coordinate that follows it


def followers_of_inputs(log: AlignedLog, others: Sequence[str]) -> dict[str, str]:
    """Return for each input the coordinate that follows it."""
    # NAME follows `command NAME` by definition, however slowly.
    named = {name: name.removeprefix(f"{COMMAND} ") for name in log.inputs}
    pairs = {name: other for name, other in named.items() if other in others}
    fits = [
        (_lagged_correlation(log, name, other), name, other)
        for name in log.inputs
        for other in others
        if log.units.get(name, "") in ("", log.units.get(other, "")) or not log.units.get(other)
    ]
    for score, name, other in sorted(fits, reverse=True):
        if score > FOLLOWS_CORRELATION and name not in pairs and other not in pairs.values():
            pairs[name] = other
    return pairs


def _lagged_correlation(log: AlignedLog, name: str, other: str) -> float:
    """Return the best correlation of an input with a coordinate up to `MAX_LAG` later; 0 if the gain is not near 1."""
    lags = np.arange(0.0, MAX_LAG, max(log.step, 0.025))
    pairs = (log.rows_apart(round(lag / log.step)) for lag in lags)
    return max(_near_correlation(log.columns[name][i], log.columns[other][j]) for i, j in pairs)


def _near_correlation(one: Array, other: Array) -> float:
    """Return the correlation of two series; 0 if the gain is not near 1."""
    value, gain = agreement(one, other)
    return value if same_gain(gain) else 0.0


def delay_of(log: AlignedLog, name: str, follower: str) -> float | None:
    """Return the delay in s from an input to the coordinate that follows it, or None if nothing moved."""
    series = [(log.time[r], log.columns[name][r], log.columns[follower][r]) for r in log.runs()]
    recordings = [((t, u), (t, values), float(t[0]), float(t[-1])) for t, u, values in series]
    return estimate_delay(recordings, log.period)


def largest_change(log: AlignedLog, name: str) -> float:
    """Return the largest change of an input over one period."""
    return float(np.abs(log.change(name, *log.spans(log.period))).max())


def braking_per_period(log: AlignedLog, name: str) -> float:
    """Return the 95 % quantile of the decrease of a coordinate's magnitude per period, without noise."""
    i, j = log.spans(log.period)
    size = np.abs(log.columns[name])
    decrease = size[i] - size[j]
    decrease = decrease[decrease > 0.02 * size.max()]
    return float(np.quantile(decrease, 0.95)) if len(decrease) >= FEWEST_SPANS else 0.0


def moves_alone(log: AlignedLog, name: str) -> bool | None:
    """Return whether the input moves the robot while all others are zero; None if that was never recorded."""
    i, j = log.spans(max(2.0 * log.period, SPAN))
    way = np.linalg.norm([log.change(p, i, j) for p in log.positions], axis=0)
    sizes = {n: np.abs(log.columns[n]) / np.abs(log.columns[n]).max() for n in log.inputs}
    alone = np.all([size > 0.2 if n == name else size <= 0.05 for n, size in sizes.items()], axis=0)
    count = np.concatenate([[0], np.cumsum(alone)])
    before = np.maximum(i - (j - i), 0)  # and for as long before, so that earlier motion has ended
    isolated = way[count[j + 1] - count[before] == j + 1 - before]
    if len(isolated) < FEWEST_SPANS:
        return None
    return bool(np.quantile(isolated, 0.5) > 0.1 * np.quantile(way, 0.9))

"""How a robot answers to its inputs, as a log shows it: what follows an input, how late and how fast."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence

import numpy as np

from brakeline.deploy.data.aligned_log import AlignedLog
from brakeline.deploy.data.motion_check import FEWEST_SPANS, MAX_LAG, SPAN, agreement, same_gain
from brakeline.deploy.data.sources.quantity_names import COMMAND
from brakeline.deploy.data.sources.source_table import Array, Series
from brakeline.messaging.robot import Robot

FOLLOWS_CORRELATION = 0.6  # of an input with the coordinate that follows it
STEPS_PER_PERIOD = 10  # resolution of the delay, if the source is sampled that often
MAX_DELAY = 3.0  # periods
NEAR = 0.1  # of a time step: closer times are the same, but for rounded stamps


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
    fits = (agreement(log.columns[name][i], log.columns[other][j]) for i, j in pairs)
    return max(correlation if same_gain(gain) else 0.0 for correlation, gain in fits)


def delay_of(log: AlignedLog, name: str, follower: str) -> float | None:
    """Return the delay in s from an input to the coordinate that follows it, or None if nothing moved."""
    series = [(log.time[r], log.columns[name][r], log.columns[follower][r]) for r in log.runs()]
    recordings = [((t, u), (t, values), float(t[0]), float(t[-1])) for t, u, values in series]
    return estimate_delay(recordings, log.period)


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


def followed_inputs(robot: Robot) -> Iterator[tuple[int, int]]:
    """Yield (input index, state index) for each input that a state coordinate follows."""
    return ((i, index) for i, index in enumerate(robot.follows) if index >= 0)


def estimate_delay(recordings: Sequence[tuple[Series, Series, float, float]], period: float) -> float | None:
    """Return the dead time in s from an input to its follower, or None if nothing moved.

    The delay is the shift at which the changes of both over one time step correlate most, whatever the sign. A
    first-order lag responds most strongly at once. Therefore it does not count, and the result is the dead time, to one
    time step.

    Args:
        recordings: for each recording the series (time, values) of input and follower, and its begin and end in s.
        period: the robot's period in s.
    """
    step, responses = response_by_lag(recordings, period)
    after = np.abs(responses[len(responses) // 2 :][: math.ceil(MAX_DELAY * period / step) + 1])
    return step * float(after.argmax()) if after.max() > 0.0 else None


def response_by_lag(recordings: Sequence[tuple[Series, Series, float, float]], period: float) -> tuple[float, Array]:
    """Return a time step in s, and the correlation of the changes of input and follower over it, by lag.

    The lags are -n, ..., n time steps, of which n are `MAX_DELAY` periods or `MAX_LAG`. At a negative lag, the follower
    changes before its input. If the input or the follower never changes, all correlations are 0.
    """
    apart = np.concatenate([np.diff(follower[0]) for _, follower, _, _ in recordings])
    usual = float(np.quantile(apart, 0.5, method="lower"))
    # The mean, because rounded stamps differ by more than the median shows: its multiples would drift off the samples.
    sampled = float(apart[np.abs(apart - usual) <= NEAR * usual].mean())
    step = max(sampled, period / STEPS_PER_PERIOD)
    most = math.ceil(max(MAX_DELAY * period, MAX_LAG) / step)
    lags = range(-most, most + 1)
    total, energy, motion = np.zeros(len(lags)), 0.0, 0.0
    for inputs, (follower_time, follower), begin, end in recordings:
        times = np.arange(begin, end, step)
        if len(times) <= most + 2:
            continue
        changed = np.diff(hold_at(inputs, times + NEAR * step))
        moved = np.diff(np.interp(times, follower_time, follower))
        # A change at t[i] shows in the step after t[i].
        changed, moved = changed[:-1], moved[1:]
        n = len(changed)
        total += [float(changed[max(-k, 0) : n - max(k, 0)] @ moved[max(k, 0) : n + min(k, 0)]) for k in lags]
        energy, motion = energy + float(changed @ changed), motion + float(moved @ moved)
    size = float(np.sqrt(energy * motion))
    return step, total / size if size > 0.0 else total


def hold_at(series: Series, times: Array) -> Array:
    """Return the last value of a series at or before each time."""
    time, values = series
    return values[np.clip(np.searchsorted(time, times, "right") - 1, 0, None)]

"""Estimate the delay from an input to the coordinate that follows it, by cross-correlation."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from brakeline.deploy.data.sources.source_table import Series
from brakeline.messaging.robot import Robot

STEPS_PER_PERIOD = 10  # resolution of the delay, if the source is sampled that often
MAX_DELAY = 3.0  # periods


def followed_inputs(robot: Robot) -> Iterator[tuple[int, int]]:
    """Yield (input index, state index) for each input that a state coordinate follows."""
    return ((i, index) for i, index in enumerate(robot.follows) if index >= 0)


def estimate_delay(recordings: Sequence[tuple[Series, Series, float, float]], period: float) -> float | None:
    """Return the dead time in s from an input to its follower, or None if nothing moved.

    The delay is the shift at which the changes of both over one time step correlate most. A first-order lag responds
    most strongly at once. Therefore it does not count, and the result is the dead time, to one time step.

    Args:
        recordings: for each recording the series (time, values) of input and follower, and its begin and end in s.
        period: the robot's period in s.
    """
    sampled = float(np.median(np.concatenate([np.diff(follower[0]) for _, follower, _, _ in recordings])))
    step = max(sampled, period / STEPS_PER_PERIOD)
    most = int(np.ceil(MAX_DELAY * period / step))
    total = np.zeros(most + 1)
    energy = 0.0
    for (input_time, inputs), (follower_time, follower), begin, end in recordings:
        times = np.arange(begin, end, step)
        if len(times) <= most + 2:
            continue
        held = inputs[np.clip(np.searchsorted(input_time, times + 1e-6 * step, "right") - 1, 0, None)]
        changed, moved = np.diff(held), np.diff(np.interp(times, follower_time, follower))
        # A change at t[i] shows in the step after t[i].
        total += [float(changed[: len(changed) - j - 1] @ moved[j + 1 :]) for j in range(most + 1)]
        energy += float(changed @ changed)
    if energy == 0.0 or total.max() <= 0.0:
        return None
    return step * float(total.argmax())

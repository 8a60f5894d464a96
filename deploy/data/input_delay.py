"""How much later a robot moves than it was told to: the cross-correlation of its inputs with what follows them."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from brakeline.messaging.robot import Array, Robot

Series = tuple[Array, Array]
PARTS = 10  # of a period, that delays are told apart to, if the source is as fine
MOST = 3.0  # periods: the longest delay that is looked for


def followed_inputs(robot: Robot) -> Iterator[tuple[int, int]]:
    """The inputs that a coordinate of the state comes to, each with it."""
    return ((i, index) for i, index in enumerate(robot.follows) if index >= 0)


def estimate_delay(recordings: Sequence[tuple[Series, Series, float, float]], period: float) -> float | None:
    """s from an input to what follows it, over (input, follower, begin, end) of each recording; None: nothing moved.

    The shift at which the changes of the one and of the other over a step of time correlate most. Of a first-order
    lag the response to a change is strongest at once, so it counts for nothing here: what is told is the dead time, to
    a step of time.
    """
    sampled = float(np.median(np.concatenate([np.diff(follower[0]) for _, follower, _, _ in recordings])))
    step = max(sampled, period / PARTS)
    most = int(np.ceil(MOST * period / step))
    total = np.zeros(most + 1)
    energy = 0.0
    for (given, values), (seen, follows), begin, end in recordings:
        times = np.arange(begin, end, step)
        if len(times) <= most + 2:
            continue
        held = values[np.clip(np.searchsorted(given, times + 1e-6 * step, "right") - 1, 0, None)]
        told, moved = np.diff(held), np.diff(np.interp(times, seen, follows))
        # What changed by t[i] shows in the step after t[i].
        total += [float(told[: len(told) - j - 1] @ moved[j + 1 :]) for j in range(most + 1)]
        energy += float(told @ told)
    if energy == 0.0 or total.max() <= 0.0:
        return None
    return step * float(total.argmax())

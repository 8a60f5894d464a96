"""Compiled: groups of periods on a nominal path, and the gaps between them and the shadows (`shadow_kernels.py`).

Consecutive periods on a short part of the nominal path form a *group*. Lengths are in m and positions are relative to
one origin.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from brakeline.compilation import compiled
from brakeline.messaging.obstacle import Array
from brakeline.safety.perception.kernels.shadow_kernels import (
    AXIS_X,
    AXIS_Y,
    AXIS_Z,
    LENGTH,
    NEAR_RADIUS,
    NEAR_X,
    NEAR_Y,
    NEAR_Z,
    TAPER,
    Single,
)

BLOCK = 128  # numbers that one search for a minimum covers


@compiled("i8[::1](f8[:,::1], f8)")
def group_periods(ends: Array, shared: float) -> NDArray[np.int64]:
    """Return the first period (G,) of each group: a group begins with each further `shared` of path (N+1, 3).

    A period whose path length is NaN is a group of its own.
    """
    first, count, length, part = np.zeros(len(ends) - 1, np.int64), 1, 0.0, 0.0
    for k in range(len(first)):
        step = ends[k + 1] - ends[k]
        length += math.sqrt(step[0] ** 2 + step[1] ** 2 + step[2] ** 2)
        before, part = part, np.floor(length / shared)
        if k > 0 and part != before:  # NaN differs from NaN
            first[count] = k
            count += 1
    return first[:count]


@compiled("void(f4[::1], f4[:,::1], f4[::1])")
def _lower_gaps(position: Single, capsules: Single, gaps: Single) -> None:
    """Lower each gap (n,) to the distance from a position (3,) to the capsule, if that is smaller."""
    a, b, c, zero = position[0], position[1], position[2], np.float32(0.0)
    x, y, z = capsules[NEAR_X], capsules[NEAR_Y], capsules[NEAR_Z]
    u, v, w = capsules[AXIS_X], capsules[AXIS_Y], capsules[AXIS_Z]
    length, radius, taper = capsules[LENGTH], capsules[NEAR_RADIUS], capsules[TAPER]
    for s in range(len(gaps)):
        p, q, r = a - x[s], b - y[s], c - z[s]  # subtract first: far away, a difference of squares is all rounding
        t = p * u[s] + q * v[s] + r * w[s]
        t = t if t > zero else zero
        t = t if t < length[s] else length[s]
        p, q, r = p - t * u[s], q - t * v[s], r - t * w[s]
        gap = np.sqrt(p * p + q * q + r * r) - radius[s] - t * taper[s]
        gaps[s] = gaps[s] if gap >= gaps[s] else gap


@compiled("f4[:,::1](f4[:,::1], f8[:,::1], i8[::1])")
def group_gaps(capsules: Single, ends: Array, first: NDArray[np.int64]) -> Single:
    """Return the approximate gaps (G, n) [m] from each group to each capsule, at the ends of the group's periods.

    ends: (N+1, 3) positions; first: (G,) the first period of each group.
    """
    n, periods = capsules.shape[1], len(ends) - 1
    gaps = np.full((len(first), n), np.inf, np.float32)
    for group in range(len(first)):
        until = first[group + 1] if group + 1 < len(first) else periods
        own = gaps[group]
        _lower_gaps(ends[first[group]].astype(np.float32), capsules, own)
        if group > 0:  # the group before ends where this one begins
            before = gaps[group - 1]
            for s in range(n):
                before[s] = own[s] if own[s] < before[s] else before[s]
        for end in range(first[group] + 1, until + (group + 1 == len(first))):
            _lower_gaps(ends[end].astype(np.float32), capsules, own)
    return gaps


@compiled("i8(i4[::1])")
def first_minimum(values: NDArray[np.int32]) -> int:
    """Return the index of the first minimum of n >= 1 numbers.

    Called with the bits of floats: as integers, those of numbers that are not negative have the same order. LLVM
    vectorises a minimum of integers.
    """
    best, at = values[0], 0
    for begin in range(0, len(values), BLOCK):
        block, least = values[begin : begin + BLOCK], best
        for k in range(len(block)):
            least = block[k] if block[k] < least else least
        if least < best:
            best, at = least, begin
    while values[at] != best:
        at += 1
    return at


@compiled("i8(f8[:,::1], i8[::1], f4[:,::1], f8)")
def count_free_groups(ends: Array, first: NDArray[np.int64], gaps: Single, touching: float) -> int:
    """Return how many of the first groups have only finite ends (N+1, 3) and gaps (G, n) above `touching`."""
    for group in range(len(first)):
        until = first[group + 1] if group + 1 < len(first) else len(ends) - 1
        own = gaps[group]
        least = own[first_minimum(own.view(np.int32))]  # any negative number has smaller bits than all that are not
        if not (least > touching and np.isfinite(ends[first[group] : until + 1]).all()):
            return group
    return len(first)


@compiled("f8(f8[::1], f8[:,:,::1], i8)")
def _farthest_corner(position: Array, boxes: Array, end: int) -> float:
    """Return the distance from a position (3,) to the farthest corner of the box of one end."""
    square = 0.0
    for axis in range(3):
        square += max(boxes[1, end, axis] - position[axis], position[axis] - boxes[0, end, axis]) ** 2
    return math.sqrt(square)


@compiled("f8[::1](f8[:,::1], i8[::1], i8, f8[:,:,::1], f8[::1], f8)")
def group_reach(ends: Array, first: NDArray[np.int64], free: int, boxes: Array, growth: Array, body: float) -> Array:
    """Return how far (free,) from its ends (N+1, 3) a capsule may be that a body in the boxes of a group can touch.

    Between two ends, a box is no farther from the nearer end than the corners at the ends plus half the step. The last
    free group also serves all later periods, so their boxes count from its last end.
    """
    reach, periods = np.zeros(free), len(ends) - 1
    for group in range(free):
        until = first[group + 1] if group + 1 < len(first) else periods
        most, step = 0.0, 0.0
        for end in range(first[group], until + 1):
            square = 0.0
            for axis in range(3):
                square += (ends[end, axis] - ends[max(end - 1, first[group]), axis]) ** 2
            most, step = max(most, _farthest_corner(ends[end], boxes, end)), max(step, square)
        most, last = most + 0.5 * math.sqrt(step), until
        if group == free - 1:
            last = periods
            for end in range(until, periods + 1):
                most = max(most, _farthest_corner(ends[until], boxes, end))
        reach[group] = most + body + growth[last - 1]
    return reach

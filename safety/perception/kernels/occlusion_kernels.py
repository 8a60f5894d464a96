"""Compiled: few half-spaces that keep a plan off thousands of shadows (`occluded_regions.py`).

A shadow is a tapered capsule (`shadow_kernels.py`). The periods of a group (`group_kernels.py`) share half-spaces. A
group's *chord* goes from the start of its first period to the end of its last. Where not stated otherwise, lengths are
in m and positions are relative to one origin.
"""

from __future__ import annotations

import math
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from brakeline.compilation import compiled
from brakeline.messaging.obstacle import FARTHEST, Array
from brakeline.safety.filter.halfspaces import TOUCHING
from brakeline.safety.perception.kernels.group_kernels import (
    count_free_groups,
    first_minimum,
    group_gaps,
    group_periods,
    group_reach,
)
from brakeline.safety.perception.kernels.shadow_kernels import (
    AXIS_X,
    AXIS_Y,
    AXIS_Z,
    EXTENT,
    FAR_RADIUS,
    LENGTH,
    NEAR_RADIUS,
    NEAR_X,
    NEAR_Y,
    NEAR_Z,
    Single,
    rounding,
)

Planes: TypeAlias = tuple[Array, Array]
Normal: TypeAlias = tuple[np.float32, np.float32, np.float32]

SHARED = 0.6  # m of the nominal path, about, along which periods form a group
COMPACT = 6  # capsules are moved together when at most one of so many is left
ALTERNATIONS = 3  # steps towards the closest points of two segments
RELAXED = 8  # half-spaces after which each capsule gives up twice as much of its gap
SUPPORT_ROWS = FAR_RADIUS + 1  # rows of the capsules that the search for half-spaces reads


@compiled("f4(f4[::1])")
def _maximum_or_nan(values: Single) -> np.float32:
    """Return the maximum of n >= 1 numbers that are not negative, or NaN if any is NaN: its bits exceed infinity's."""
    bits, most, magnitude = values.view(np.int32), np.int32(0), np.int32(0x7FFFFFFF)
    for k in range(len(bits)):
        own = bits[k] & magnitude
        most = own if own > most else most
    one = np.empty(1, np.int32)
    one[0] = most
    return np.float32(one.view(np.float32)[0])


@compiled("Tuple((UniTuple(f8, 3), f8))(f4[:,::1], i8, f8[:,::1], f8)")
def _supporting_plane(
    capsules: Single, index: int, chord: Array, rounded: float
) -> tuple[tuple[float, float, float], float]:
    """Return the unit normal from a chord (2, 3) towards a capsule, and the level beyond which the capsule lies.

    The normal joins the closest points of the chord and the capsule's axis, which alternating projections approximate.
    The level holds for any normal.
    """
    near, axis = np.empty(3), np.empty(3)
    square = 0.0
    for i in range(3):
        near[i], axis[i] = capsules[NEAR_X + i, index], capsules[AXIS_X + i, index]
        square += (chord[1, i] - chord[0, i]) ** 2
    length, share, square = float(capsules[LENGTH, index]), 0.5, max(square, TOUCHING**2)
    towards = np.zeros(3)
    for _ in range(ALTERNATIONS):
        t = 0.0
        for i in range(3):
            t += (chord[0, i] + share * (chord[1, i] - chord[0, i]) - near[i]) * axis[i]
        t, along = min(max(t, 0.0), length), 0.0
        for i in range(3):
            towards[i] = near[i] + t * axis[i] - chord[0, i]
            along += towards[i] * (chord[1, i] - chord[0, i])
            towards[i] -= share * (chord[1, i] - chord[0, i])
        share = min(max(along / square, 0.0), 1.0)
    norm = max(math.sqrt(towards[0] ** 2 + towards[1] ** 2 + towards[2] ** 2), TOUCHING)
    x, y, z = towards[0] / norm, towards[1] / norm, towards[2] / norm
    at_near = x * near[0] + y * near[1] + z * near[2]
    at_far = at_near + length * (x * axis[0] + y * axis[1] + z * axis[2])
    return (x, y, z), min(at_near - capsules[NEAR_RADIUS, index], at_far - capsules[FAR_RADIUS, index]) - rounded


@compiled("void(f4[:,::1], UniTuple(f4, 3), f4, f4, f4[::1])")
def _drop_beyond(capsules: Single, normal: Normal, level: np.float32, margin: np.float32, gaps: Single) -> None:
    """Set the gap of each capsule to infinity that lies beyond a half-space by the margin or more.

    The first capsules, as many as there are gaps, are tested.
    """
    a, b, c = normal
    x, y, z = capsules[NEAR_X], capsules[NEAR_Y], capsules[NEAR_Z]
    u, v, w = capsules[AXIS_X], capsules[AXIS_Y], capsules[AXIS_Z]
    length, near_radius, far_radius = capsules[LENGTH], capsules[NEAR_RADIUS], capsules[FAR_RADIUS]
    done = np.float32(np.inf)
    for s in range(len(gaps)):
        near = a * x[s] + b * y[s] + c * z[s] - level
        far = near + length[s] * (a * u[s] + b * v[s] + c * w[s]) - far_radius[s]
        near -= near_radius[s]
        beyond = near if near < far else far
        gaps[s] = done if beyond >= margin else gaps[s]


@compiled("i8(f4[:,::1], f4[:,::1], f4[::1], i8[::1])")
def _compact(capsules: Single, remaining: Single, gaps: Single, index: NDArray[np.int64]) -> int:
    """Move the capsules with a finite gap to the front of `remaining` and their gaps to the front of `gaps`, if few.

    Returns how many are left. If all stay where they are, it is the number of gaps. index: (n,) work space.
    """
    n, left = len(gaps), 0
    for s in range(n):
        left += gaps[s] != np.inf
    if COMPACT * left > n:
        return n
    left = 0
    for s in range(n):
        index[left] = s
        left += gaps[s] != np.inf
    for row in range(SUPPORT_ROWS):
        values, out = capsules[row], remaining[row]
        for k in range(left):
            out[k] = values[index[k]]
    for k in range(left):
        gaps[k] = gaps[index[k]]
    return left


@compiled(
    "i8(f4[:,::1], f8[:,::1], f4[::1], UniTuple(f8, 3), Tuple((f8[:,::1], f8[::1])), Tuple((f4[:,::1], i8[::1])))"
)
def _separate(
    capsules: Single,
    chord: Array,
    gaps: Single,
    search: tuple[float, float, float],
    planes: Planes,
    work: tuple[Single, NDArray[np.int64]],
) -> int:
    """Write half-spaces around one chord until each capsule with a finite gap is beyond one, and return their number.

    Args:
        gaps: (n,) not negative, overwritten. Infinity marks a capsule that is out of reach.
        search: (keep_off, give, rounded) as in `supporting_planes`.
        planes: normals (k, 3) and levels (k,) to write. If k do not suffice, the last level becomes -inf.
        work: capsules (SUPPORT_ROWS, n) and indices (n,) to overwrite.
    """
    keep_off, give, rounded = search
    normals, levels = planes
    remaining, index = work
    margin, most, rest = np.float32(rounded), len(levels), capsules
    for k in range(most):
        nearest = first_minimum(gaps.view(np.int32))
        if gaps[nearest] == np.inf:
            return k
        normal, level = _supporting_plane(rest, nearest, chord, rounded)
        level -= give * 2.0 ** (k // RELAXED) * max(gaps[nearest] - keep_off, 0.0)
        normals[k, 0], normals[k, 1], normals[k, 2], levels[k] = normal[0], normal[1], normal[2], level
        single = np.float32(normal[0]), np.float32(normal[1]), np.float32(normal[2])
        _drop_beyond(rest, single, np.float32(level), margin, gaps)
        gaps[nearest] = np.inf
        left = _compact(rest, remaining, gaps, index)
        if left < len(gaps):
            gaps, rest = gaps[:left], remaining
        if left == 0:
            return k + 1
    levels[most - 1] = -np.inf
    return most


@compiled("Tuple((f8[:,:,::1], f8[:,::1]))(f4[:,::1], f8[:,:,::1], f4[:,::1], f8[::1], i8, UniTuple(f8, 3))")
def supporting_planes(
    capsules: Single, chords: Array, gaps: Single, reach: Array, most: int, search: tuple[float, float, float]
) -> Planes:
    """Return half-spaces around each chord, until each capsule within reach is beyond one of them.

    Args:
        chords: (G, 2, 3).
        gaps: (G, n) from each chord to each capsule, not negative.
        reach: (G,) farther capsules need no half-space.
        most: half-spaces of a chord. If they do not suffice, the last one has level -inf.
        search: keep_off, the body's radius; give, as `occluded_regions.GIVE`; rounded, the error of single precision.

    Returns:
        normals (G, k, 3) and levels (G, k), with k the largest number that a chord needs. Unused levels are `FARTHEST`.
    """
    normals, levels, needed = np.zeros((len(chords), most, 3)), np.full((len(chords), most), FARTHEST), 0
    n = capsules.shape[1]
    gaps, work = gaps.copy(), (np.empty((SUPPORT_ROWS, n), np.float32), np.empty(n, np.int64))
    for group in range(len(chords)):
        own, within = gaps[group], np.float32(reach[group])
        for s in range(n):
            own[s] = np.float32(np.inf) if own[s] > within else own[s]
        needed = max(needed, _separate(capsules, chords[group], own, search, (normals[group], levels[group]), work))
    return normals[:, :needed].copy(), levels[:, :needed].copy()


@compiled(
    "Tuple((f8[:,:,::1], f8[:,::1]))(Tuple((f8[:,:,::1], f8[:,::1])), i8[::1], f8[:,:,::1], f8[::1],"
    " Tuple((f8, f8[::1])), f8[::1])"
)
def period_planes(
    planes: Planes, first: NDArray[np.int64], boxes: Array, growth: Array, margins: tuple[float, Array], offset: Array
) -> Planes:
    """Return the half-spaces of all periods for the measured position: normals (k+6, N, 3) and levels (k+6, N).

    The last six are the faces around both boxes of a period. Periods after the last group use its half-spaces.

    Args:
        planes: normals (G, k, 3) and levels (G, k) of the groups.
        first: (G,) the first period of each group.
        boxes: (2, N+1, 3) lowest and highest corners of the body's positions at the periods' ends.
        growth: (N,) how far an occluded obstacle may have moved at the end of each period.
        margins: keep_off, the body's radius, and the position error (3,).
        offset: (3,) origin of the returned levels.
    """
    group_normals, group_levels = planes
    keep_off, position_error = margins
    count, periods = group_levels.shape[1], len(growth)
    normals, levels = np.zeros((count + 6, periods, 3)), np.empty((count + 6, periods))
    group = 0
    for k in range(periods):
        group += group + 1 < len(group_levels) and k >= first[group + 1]
        for i in range(count):
            normal, margin = group_normals[group, i], 0.0
            if normal[0] != 0.0 or normal[1] != 0.0 or normal[2] != 0.0:
                margin = growth[k] + keep_off
            for axis in range(3):
                normals[i, k, axis] = normal[axis]
                margin += abs(normal[axis]) * position_error[axis] + normal[axis] * offset[axis]
            levels[i, k] = group_levels[group, i] - margin
        for axis in range(3):
            upper, lower = count + axis, count + 3 + axis
            normals[upper, k, axis], normals[lower, k, axis] = 1.0, -1.0
            levels[upper, k] = max(boxes[1, k, axis], boxes[1, k + 1, axis]) - offset[axis]
            levels[lower, k] = offset[axis] - min(boxes[0, k, axis], boxes[0, k + 1, axis])
    return normals, levels


@compiled("Tuple((f8[:,::1], f8[:,:,::1]))(f8[::1], Tuple((f8[::1], f8[:,::1], f8[:,:,::1])))")
def _relative(origin: Array, plan: tuple[Array, Array, Array]) -> tuple[Array, Array]:
    """Return the start and the ends of all periods (N+1, 3), and their boxes (2, N+1, 3), relative to the origin."""
    start, nominal, boxes = plan
    ends, within, last = np.empty((len(nominal) + 1, 3)), np.empty((2, len(nominal) + 1, 3)), boxes.shape[1] - 1
    for k in range(len(ends)):
        for axis in range(3):
            for side in range(2):
                within[side, k, axis] = boxes[side, min(k, last), axis] - origin[axis]
            ends[k, axis] = (nominal[k - 1, axis] if k > 0 else start[axis]) - origin[axis]
    return ends, within


@compiled(
    "Tuple((f8[:,:,::1], f8[:,::1]))(f4[:,::1], f8[::1], Tuple((f8[::1], f8[:,::1], f8[:,:,::1])), UniTuple(f8, 2),"
    " Tuple((f8, f8[::1])), Tuple((i8, f8)))"
)
def path_planes(
    capsules: Single,
    origin: Array,
    plan: tuple[Array, Array, Array],
    motion: tuple[float, float],
    margins: tuple[float, Array],
    search: tuple[int, float],
) -> Planes:
    """Return the half-spaces of all periods of a nominal path, relative to its start, as `period_planes` does.

    Half-spaces with level -inf say that nothing is free: the start touches a shadow, or a number is not finite or too
    large for single precision.

    Args:
        capsules: (ROWS, n) shadows, relative to the origin.
        origin: (3,) world.
        plan: start (3,), ends of the periods (N, 3), and boxes (2, N+1 or 1, 3), world.
        motion: how far an occluded obstacle may have moved until now, and how far it moves in a period.
        margins: keep_off, the body's radius, and the position error (3,).
        search: the largest number of half-spaces of a period, and give (`supporting_planes`).
    """
    keep_off, position_error = margins
    most, give = search
    ends, boxes = _relative(origin, plan)
    growth, first = motion[0] + motion[1] * np.arange(1.0, len(ends)), np.zeros(1, np.int64)
    start, no_planes = ends[0].copy(), (np.zeros((1, 0, 3)), np.zeros((1, 0)))
    faces, levels = period_planes(no_planes, first, boxes, growth, margins, start)
    nothing_free = np.full_like(levels, -np.inf)
    if not (np.abs(boxes) <= FARTHEST).all():  # before any maximum, which may ignore NaN
        return faces, nothing_free
    if capsules.shape[1] == 0:
        return faces, levels
    first, extent = group_periods(ends, SHARED), _maximum_or_nan(capsules[EXTENT])
    if not extent <= FARTHEST:
        return faces, nothing_free
    rounded = rounding(extent + np.abs(boxes).max())
    gaps = group_gaps(capsules, ends, first)
    free = count_free_groups(ends, first, gaps, TOUCHING)
    if free == 0:
        return faces, nothing_free
    chords = np.empty((free, 2, 3))
    for group in range(free):
        until = first[group + 1] if group + 1 < len(first) else len(ends) - 1
        chords[group, 0], chords[group, 1] = ends[first[group]], ends[until]
    reach = group_reach(ends, first, free, boxes, growth, keep_off + position_error.sum() + rounded)
    planes = supporting_planes(capsules, chords, gaps[:free], reach, most, (keep_off, give, rounded))
    return period_planes(planes, first, boxes, growth, margins, start)

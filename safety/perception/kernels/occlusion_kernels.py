"""How near shadows are, and the half-spaces that keep off all of them, compiled (`occluded_regions.py`).

Shadows are told as lines: `casting.py` says what those are.
"""

from __future__ import annotations

import math
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from brakeline.safety.compilation import compiled
from brakeline.safety.filter.halfspaces import TOUCHING
from brakeline.safety.perception.kernels.shadow_kernels import rounding

Array = NDArray[np.float64]
Single = NDArray[np.float32]

Normal: TypeAlias = tuple[np.float32, np.float32, np.float32]

FEW = 6  # of so many that are looked at one is left: then they are moved together
ALTERNATIONS = 3  # between two segments, until their nearest points are known well enough
BLOCK = 128  # numbers that the least of is looked for at a time


@compiled("void(f4[::1], f4[:,::1], f4[::1])")
def _room(place: Single, lines: Single, found: Single) -> None:
    """How near each shadow is to a place, where that is nearer than was found before."""
    a, b, c, zero = place[0], place[1], place[2], np.float32(0.0)
    x, y, z, u, v, w = lines[0], lines[1], lines[2], lines[3], lines[4], lines[5]
    length, about, widening = lines[6], lines[7], lines[9]
    for s in range(len(found)):
        p, q, r = a - x[s], b - y[s], c - z[s]  # first: far away, the squares' difference would be all rounding
        t = p * u[s] + q * v[s] + r * w[s]
        t = t if t > zero else zero
        t = t if t < length[s] else length[s]
        p, q, r = p - t * u[s], q - t * v[s], r - t * w[s]
        room = np.sqrt(p * p + q * q + r * r) - about[s] - t * widening[s]
        found[s] = found[s] if room >= found[s] else room


@compiled("f4[:,::1](f4[:,::1], f8[:,::1], i8[::1])")
def rooms(lines: Single, ends: Array, first: NDArray[np.int64]) -> Single:
    """About how near [m] each shadow is to any of the ends (N+1, 3) of the periods of each group, which begins with so
    many a period (G,): (G, n)."""
    n, periods = lines.shape[1], len(ends) - 1
    found = np.full((len(first), n), np.inf, np.float32)
    for group in range(len(first)):
        until = first[group + 1] if group + 1 < len(first) else periods
        own = found[group]
        _room(ends[first[group]].astype(np.float32), lines, own)
        if group > 0:  # where one group begins, the one before ends
            before = found[group - 1]
            for s in range(n):
                before[s] = own[s] if own[s] < before[s] else before[s]
        for end in range(first[group] + 1, until + (group + 1 == len(first))):
            _room(ends[end].astype(np.float32), lines, own)
    return found


@compiled("i8(i4[::1])")
def _least(values: NDArray[np.int32]) -> int:
    """Which of n >= 1 is the least. Of numbers that are not negative their bits, as integers, are in the same order,
    which many at a time can be compared in."""
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


@compiled("f4(f4[::1])")
def _greatest(values: Single) -> np.float32:
    """The greatest of n >= 1 numbers that are not negative, no number where one of them is none: its bits are greater
    than infinity's."""
    bits, most, unsigned = values.view(np.int32), np.int32(0), np.int32(0x7FFFFFFF)
    for k in range(len(bits)):
        own = bits[k] & unsigned
        most = own if own > most else most
    one = np.empty(1, np.int32)
    one[0] = most
    return np.float32(one.view(np.float32)[0])


@compiled("Tuple((UniTuple(f8, 3), f8))(f4[:,::1], i8, f8[:,::1], f8)")
def _support(lines: Single, shadow: int, chord: Array, rounded: float) -> tuple[tuple[float, float, float], float]:
    """The unit normal from a chord (2, 3), from the start, towards a shadow, and the level that it lies beyond."""
    near, along = np.empty(3), np.empty(3)
    square = 0.0
    for i in range(3):
        near[i], along[i] = lines[i, shadow], lines[3 + i, shadow]
        square += (chord[1, i] - chord[0, i]) ** 2
    length, share, square = float(lines[6, shadow]), 0.5, max(square, TOUCHING**2)
    towards = np.zeros(3)
    for _ in range(ALTERNATIONS):
        t = 0.0
        for i in range(3):
            t += (chord[0, i] + share * (chord[1, i] - chord[0, i]) - near[i]) * along[i]
        t, sum_ = min(max(t, 0.0), length), 0.0
        for i in range(3):
            towards[i] = near[i] + t * along[i] - chord[0, i]
            sum_ += towards[i] * (chord[1, i] - chord[0, i])
            towards[i] -= share * (chord[1, i] - chord[0, i])
        share = min(max(sum_ / square, 0.0), 1.0)
    norm = max(math.sqrt(towards[0] ** 2 + towards[1] ** 2 + towards[2] ** 2), TOUCHING)
    x, y, z = towards[0] / norm, towards[1] / norm, towards[2] / norm
    at_near = x * near[0] + y * near[1] + z * near[2]
    at_far = at_near + length * (x * along[0] + y * along[1] + z * along[2])
    return (x, y, z), min(at_near - lines[7, shadow], at_far - lines[8, shadow]) - rounded


@compiled("void(f4[:,::1], UniTuple(f4, 3), f4, f4, f4[::1])")
def _without_beyond(lines: Single, normal: Normal, level: np.float32, surely: np.float32, room: Single) -> None:
    """Of the first shadows, as many as there are rooms, those that are so far [m] beyond a half-space are done with:
    the room to them is infinite."""
    a, b, c = normal
    x, y, z, u, v, w = lines[0], lines[1], lines[2], lines[3], lines[4], lines[5]
    length, about_near, about_far, done = lines[6], lines[7], lines[8], np.float32(np.inf)
    for s in range(len(room)):
        near = a * x[s] + b * y[s] + c * z[s] - level
        far = near + length[s] * (a * u[s] + b * v[s] + c * w[s]) - about_far[s]
        near -= about_near[s]
        beyond = near if near < far else far
        room[s] = done if beyond >= surely else room[s]


@compiled("i8(f4[:,::1], f4[:,::1], f4[::1], i8[::1])")
def _moved_up(lines: Single, kept: Single, room: Single, index: NDArray[np.int64]) -> int:
    """How many of the first shadows, as many as there are rooms, are left. Where they are few, they and their rooms are
    moved to the front of `kept` and room; else all stay."""
    n, left = len(room), 0
    for s in range(n):
        left += room[s] != np.inf
    if FEW * left > n:
        return n
    left = 0
    for s in range(n):
        index[left] = s
        left += room[s] != np.inf
    for i in range(9):
        row, out = lines[i], kept[i]
        for k in range(left):
            out[k] = row[index[k]]
    for k in range(left):
        room[k] = room[index[k]]
    return left


@compiled("i8(f4[:,::1], f8[:,::1], f4[::1], f8, f8, f8, f8, f8[:,::1], f8[::1], f4[:,::1], i8[::1])")
def _until_beyond(
    lines: Single,
    chord: Array,
    room: Single,
    reach: float,
    keep_off: float,
    give: float,
    rounded: float,
    normals: Array,
    levels: Array,
    kept: Single,
    index: NDArray[np.int64],
) -> int:
    """Half-spaces about one chord, into normals (k, 3) and levels (k,): so many. Overwrites what it is given to work
    with: room (n,), not negative, kept (9, n), index (n,)."""
    within, surely, most, rest = np.float32(reach), np.float32(rounded), len(levels), lines
    for s in range(len(room)):
        room[s] = np.float32(np.inf) if room[s] > within else room[s]
    for k in range(most):
        chosen = _least(room.view(np.int32))
        if room[chosen] == np.inf:
            return k
        normal, level = _support(rest, chosen, chord, rounded)
        level -= give * 2.0 ** (k // 8) * max(room[chosen] - keep_off, 0.0)
        normals[k, 0], normals[k, 1], normals[k, 2], levels[k] = normal[0], normal[1], normal[2], level
        single = np.float32(normal[0]), np.float32(normal[1]), np.float32(normal[2])
        _without_beyond(rest, single, np.float32(level), surely, room)
        room[chosen] = np.inf
        left = _moved_up(rest, kept, room, index)
        if left < len(room):
            room, rest = room[:left], kept
        if left == 0:
            return k + 1
    levels[most - 1] = -np.inf
    return most


@compiled("Tuple((f8[:,:,::1], f8[:,::1]))(f4[:,::1], f8[:,:,::1], f4[:,::1], f8[::1], f8, i8, f8, f8, f8)")
def supporting(
    lines: Single,
    chords: Array,
    room: Single,
    reach: Array,
    keep_off: float,
    most: int,
    give: float,
    farthest: float,
    rounded: float,
) -> tuple[Array, Array]:
    """Half-spaces until every shadow that is within reach (G,) is beyond one of them, about each of the chords
    (G, 2, 3): normals (G, k, 3) and levels (G, k) for as many as any chord needs; those that one does not need are at
    `farthest`, and where `most` are not enough the last is at -inf. room (G, n) [m]: from the chords to the shadows,
    not negative; give: as `occluded_regions.GIVE`; rounded [m]: by how much single precision may be off."""
    normals, levels, needed = np.zeros((len(chords), most, 3)), np.full((len(chords), most), farthest), 0
    n = lines.shape[1]
    room, kept, index = room.copy(), np.empty((9, n), np.float32), np.empty(n, np.int64)
    for group in range(len(chords)):
        a, b, near, within = normals[group], levels[group], room[group], reach[group]
        count = _until_beyond(lines, chords[group], near, within, keep_off, give, rounded, a, b, kept, index)
        needed = max(needed, count)
    return normals[:, :needed].copy(), levels[:, :needed].copy()


@compiled("i8[::1](f8[:,::1], f8)")
def together(ends: Array, shared: float) -> NDArray[np.int64]:
    """The first periods of those that share half-spaces, for the nominal way (N+1, 3) hardly leads on in them."""
    first, count, way, part = np.zeros(len(ends) - 1, np.int64), 1, 0.0, 0.0
    for k in range(len(first)):
        away = ends[k + 1] - ends[k]
        way += math.sqrt(away[0] ** 2 + away[1] ** 2 + away[2] ** 2)
        before, part = part, np.floor(way / shared)  # of what is no number: no number, so a part of its own
        if k > 0 and part != before:
            first[count] = k
            count += 1
    return first[:count]


@compiled("i8(f8[:,::1], i8[::1], f4[:,::1], f8)")
def free_groups(ends: Array, first: NDArray[np.int64], room: Single, touching: float) -> int:
    """Of how many groups, from the first on, the way (N+1, 3) is free, and a number."""
    for group in range(len(first)):
        until = first[group + 1] if group + 1 < len(first) else len(ends) - 1
        near = room[group]
        least = near[_least(near.view(np.int32))]  # of a negative one, too, a negative one
        if not (least > touching and np.isfinite(ends[first[group] : until + 1]).all()):
            return group
    return len(first)


@compiled(
    "Tuple((f8[:,:,::1], f8[:,::1]))(f8[:,:,::1], f8[:,::1], i8[::1], f8[:,:,::1], f8[::1], f8, f8[::1], f8[::1])"
)
def about_periods(
    normals: Array,
    levels: Array,
    first: NDArray[np.int64],
    boxes: Array,
    grown: Array,
    keep_off: float,
    measured: Array,
    aside: Array,
) -> tuple[Array, Array]:
    """Of half-spaces (G, k) of groups those of every period, (k+6, N, 3) and (k+6, N), for a body that keeps off what
    is there, and may have grown (N,), by where it is measured; and the faces about both of its ends' boxes
    (2, N+1, 3), as they are. From a place so far aside (3,) of where these are told from. Periods after the last group
    have the last one's."""
    count, periods = levels.shape[1], len(grown)
    a, b = np.zeros((count + 6, periods, 3)), np.empty((count + 6, periods))
    group = 0
    for k in range(periods):
        group += group + 1 < len(levels) and k >= first[group + 1]
        for i in range(count):
            normal, kept = normals[group, i], 0.0
            if normal[0] != 0.0 or normal[1] != 0.0 or normal[2] != 0.0:
                kept = grown[k] + keep_off
            for axis in range(3):
                a[i, k, axis] = normal[axis]
                kept += abs(normal[axis]) * measured[axis] + normal[axis] * aside[axis]
            b[i, k] = levels[group, i] - kept
        for axis in range(3):
            a[count + axis, k, axis], a[count + 3 + axis, k, axis] = 1.0, -1.0
            b[count + axis, k] = max(boxes[1, k, axis], boxes[1, k + 1, axis]) - aside[axis]
            b[count + 3 + axis, k] = aside[axis] - min(boxes[0, k, axis], boxes[0, k + 1, axis])
    return a, b


@compiled("f8(f8[::1], f8[:,:,::1], i8)")
def _farthest_corner(place: Array, boxes: Array, end: int) -> float:
    """How far [m] from a place any point of an end's box is at the most."""
    square = 0.0
    for axis in range(3):
        square += max(boxes[1, end, axis] - place[axis], place[axis] - boxes[0, end, axis]) ** 2
    return math.sqrt(square)


@compiled("f8[::1](f8[:,::1], i8[::1], i8, f8[:,:,::1], f8[::1], f8)")
def reaches(ends: Array, first: NDArray[np.int64], free: int, boxes: Array, grown: Array, body: float) -> Array:
    """How far [m] from the ends (N+1, 3) of the periods of each of the first groups (free,) what may touch a body in
    the boxes is at the most.

    Between two ends it is nowhere farther from the nearer one than at an end, and half the way between them. The last
    free group is also that of all periods after it (`about_periods`), and what they may touch is as near to its last
    end as their boxes' corners are.
    """
    found, periods = np.zeros(free), len(ends) - 1
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
        found[group] = most + body + grown[last - 1]
    return found


@compiled("Tuple((f8[:,::1], f8[:,:,::1]))(f8[::1], f8[::1], f8[:,::1], f8[:,:,::1])")
def _from(origin: Array, start: Array, nominal: Array, boxes: Array) -> tuple[Array, Array]:
    """The start and the ends of all periods (N+1, 3) and their boxes (2, N+1, 3), as they are from the origin."""
    ends, within, last = np.empty((len(nominal) + 1, 3)), np.empty((2, len(nominal) + 1, 3)), boxes.shape[1] - 1
    for k in range(len(ends)):
        for axis in range(3):
            for side in range(2):
                within[side, k, axis] = boxes[side, min(k, last), axis] - origin[axis]
            ends[k, axis] = (nominal[k - 1, axis] if k > 0 else start[axis]) - origin[axis]
    return ends, within


@compiled(
    "Tuple((f8[:,:,::1], f8[:,::1]))"
    "(f4[:,::1], f8[::1], f8[::1], f8[:,::1], f8[:,:,::1], UniTuple(f8, 2), f8, f8[::1], i8, UniTuple(f8, 4))"
)
def about_way(
    lines: Single,
    origin: Array,
    start: Array,
    nominal: Array,
    boxes: Array,
    moved: tuple[float, float],
    keep_off: float,
    measured: Array,
    most: int,
    limits: tuple[float, float, float, float],
) -> tuple[Array, Array]:
    """The half-spaces of all periods about a nominal way (N, 3), world, from a start (3,), in boxes (2, N+1 or 1, 3),
    as `about_periods` has them, of shadows from an origin (3,). moved [m]: how far what is seen may have moved until
    now, and moves in a period; limits: `occluded_regions.SHARED`, `TOUCHING`, `GIVE`, `FARTHEST`."""
    shared, touching, give, farthest = limits
    ends, within = _from(origin, start, nominal, boxes)
    grown, first = moved[0] + moved[1] * np.arange(1.0, len(ends)), np.zeros(1, np.int64)
    aside, no, none = ends[0].copy(), np.zeros((1, 0, 3)), np.zeros((1, 0))
    faces, levels = about_periods(no, none, first, within, grown, keep_off, measured, aside)
    nowhere = np.full_like(levels, -np.inf)
    if not (np.abs(within) <= farthest).all():  # of two numbers, one of which is none, the larger may be the other
        return faces, nowhere
    if lines.shape[1] == 0:
        return faces, levels
    first, extent = together(ends, shared), _greatest(lines[10])
    if not extent <= farthest:
        return faces, nowhere
    rounded = rounding(extent + np.abs(within).max())
    room = rooms(lines, ends, first)
    free = free_groups(ends, first, room, touching)
    if free == 0:
        return faces, nowhere
    chords = np.empty((free, 2, 3))
    for group in range(free):
        until = first[group + 1] if group + 1 < len(first) else len(nominal)
        chords[group, 0], chords[group, 1] = ends[first[group]], ends[until]
    reach = reaches(ends, first, free, within, grown, keep_off + measured.sum() + rounded)
    normals, levels = supporting(lines, chords, room[:free], reach, keep_off, most, give, farthest, rounded)
    return about_periods(normals, levels, first, within, grown, keep_off, measured, aside)

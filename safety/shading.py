"""Which shadows count, how near they are, and the half-spaces that keep off all of them, compiled (`shadows.py`).

Shadows are told as `lines` (9, n), contiguous: their near ends x, y, z, the unit vectors along them x, y, z, their
length, and how wide they are about their near ends and their far ones, m.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from messaging.compiled import compiled
from safety.freespace import TOUCHING

Array = NDArray[np.float64]
Single = NDArray[np.float32]

ROUNDING = 1e-4  # m: more than directions in single precision lead aside within sight
ALTERNATIONS = 3  # between two segments, until their nearest points are known well enough


@compiled("f4[::1](f4[:,::1], i8[::1], i8)")
def nearest_of_patches(free: Single, together: NDArray[np.int64], patches: int) -> Single:
    """The least of each patch's beams: so many together in each ring (E,) of a grid (E, A)."""
    rings, columns = free.shape
    found, k = np.empty(patches, np.float32), 0
    for i in range(rings):
        ring, each = free[i], together[i]
        if each == 1:
            found[k : k + columns] = ring
            k += columns
            continue
        for j in range(0, columns, each):
            found[k] = ring[j]
            for beam in range(j + 1, min(j + each, columns)):
                found[k] = min(found[k], ring[beam])
            k += 1
    return found


@compiled("void(f4[:,::1], f4[::1], f4, f4, f4[::1], f4[::1])")
def _between_faces(ways: Single, axis: Single, low: np.float32, high: np.float32, begins: Single, ends: Single) -> None:
    """What is left of rays in directions (3, n), from `begins` to `ends`, between faces so far along an axis (3,)."""
    a, b, c = axis[0], axis[1], axis[2]
    x, y, z = ways[0], ways[1], ways[2]  # named one by one it becomes one instruction for many rays
    aside = np.float32(1e-20)
    for k in range(len(begins)):
        way = a * x[k] + b * y[k] + c * z[k]
        way = way if abs(way) > aside else aside  # beside the faces: for ever, or never
        one, other, begin, end = low / way, high / way, begins[k], ends[k]
        enters, leaves = one if one < other else other, one if one > other else other
        begins[k], ends[k] = enters if enters > begin else begin, leaves if leaves < end else end


@compiled("i8[::1](f4[:,::1], f8[:,::1], f8[::1], f8, f8[::1], f8[::1], f4[::1])")
def _that_meet(
    ways: Single, turn: Array, at: Array, last: float, low: Array, high: Array, near: Single
) -> NDArray[np.int64]:
    """Which rays come into a box, or are as near to it as `ROUNDING`, between `near` (n,) and last."""
    begins, ends = near.copy(), np.full(len(near), last, np.float32)
    for axis in range(3):
        lower, upper = np.float32(low[axis] - at[axis] - ROUNDING), np.float32(high[axis] - at[axis] + ROUNDING)
        _between_faces(ways, turn[axis].astype(np.float32), lower, upper, begins, ends)
    found, count = np.empty(len(near), np.int64), 0
    for k in range(len(near)):
        found[count] = k
        count += begins[k] <= ends[k]
    return found[:count]


@compiled("f8[:,::1](f4[:,::1], i8[::1], f4[:,::1], f8[:,::1], f8[::1], f8, f8[::1], f8[::1], f8, f8)")
def behind(
    free: Single,
    together: NDArray[np.int64],
    ways: Single,
    turn: Array,
    at: Array,
    last: float,
    low: Array,
    high: Array,
    widening: float,
    wide: float,
) -> Array:
    """The lines of what is behind patches, as many beams together as each ring (E,) of the grid has it, in directions
    (3, n) from a point, turned by (3, 3): of those that come into a box between where they are free to and `last` m.
    Wide are they by so much, and so much more a metre."""
    near = nearest_of_patches(free, together, ways.shape[1])
    index = _that_meet(ways, turn, at, last, low, high, near)
    lines = np.empty((9, len(index)))
    for axis in range(3):
        a, b, c = turn[axis, 0], turn[axis, 1], turn[axis, 2]
        for s in range(len(index)):
            k = index[s]
            lines[3 + axis, s] = a * ways[0, k] + b * ways[1, k] + c * ways[2, k]
            lines[axis, s] = at[axis] + near[k] * lines[3 + axis, s]
    for s in range(len(index)):
        least = near[index[s]]
        lines[6, s] = last - least
        lines[7, s] = least * widening + wide
        lines[8, s] = last * widening + wide
    return lines


@compiled("void(f4[::1], f4[:,::1], f4[::1])")
def _room(place: Single, told: Single, found: Single) -> None:
    """How near each shadow, as `rooms` tells them, is to a place, where that is nearer than was found before."""
    a, b, c, zero = place[0], place[1], place[2], np.float32(0.0)
    x, y, z, u, v, w = told[0], told[1], told[2], told[3], told[4], told[5]
    length, about, widening, outward, square = told[6], told[7], told[8], told[9], told[10]
    own = a * a + b * b + c * c
    for s in range(len(found)):
        away = a * u[s] + b * v[s] + c * w[s] - outward[s]
        t = away if away > zero else zero
        t = t if t < length[s] else length[s]
        aside = a * x[s] + b * y[s] + c * z[s]
        gap = square[s] - aside - aside + own + t * (t - away - away)
        gap = gap if gap > zero else zero
        room = np.sqrt(gap) - about[s] - t * widening[s]
        found[s] = room if room < found[s] else found[s]


@compiled("f4[:,::1](f8[:,::1], f8[::1], f8[:,::1], i8[::1])")
def rooms(lines: Array, start: Array, ends: Array, first: NDArray[np.int64]) -> Single:
    """About how near [m] each shadow is to any of the ends (N+1, 3), from the start, of the periods of each group,
    which begins with so many a period (G,): (G, n)."""
    n, periods = lines.shape[1], len(ends) - 1
    told, found = np.empty((11, n), np.float32), np.full((len(first), n), np.inf, np.float32)
    for i in range(8):
        told[i] = lines[i] - (start[i] if i < 3 else 0.0)
    told[8] = (lines[8] - lines[7]) / np.maximum(lines[6], TOUCHING)
    told[9] = told[0] * told[3] + told[1] * told[4] + told[2] * told[5]
    told[10] = told[0] * told[0] + told[1] * told[1] + told[2] * told[2]
    for group in range(len(first)):
        until = first[group + 1] if group + 1 < len(first) else periods
        for end in range(first[group], until + 1):
            _room(ends[end].astype(np.float32), told, found[group])
    return found


@compiled("Tuple((UniTuple(f8, 3), f8))(f8[:,::1], i8, f8[::1], f8[:,::1])")
def _support(lines: Array, shadow: np.intp, start: Array, chord: Array) -> tuple[tuple[float, float, float], float]:
    """The unit normal from a chord (2, 3), from the start, towards a shadow, and the level that it lies beyond."""
    near, along = np.empty(3), np.empty(3)
    square = 0.0
    for i in range(3):
        near[i], along[i] = lines[i, shadow] - start[i], lines[3 + i, shadow]
        square += (chord[1, i] - chord[0, i]) ** 2
    length, share, square = lines[6, shadow], 0.5, max(square, TOUCHING**2)
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
    return (x, y, z), min(at_near - lines[7, shadow], at_far - lines[8, shadow])


@compiled("void(f8[:,::1], i8, UniTuple(f8, 3), f8, f8[::1])")
def _beyond(lines: Array, count: int, normal: tuple[float, float, float], level: float, found: Array) -> None:
    """How far [m] each of the first shadows is beyond a half-space."""
    a, b, c = normal
    x, y, z, u, v, w = lines[0], lines[1], lines[2], lines[3], lines[4], lines[5]
    length, about_near, about_far = lines[6], lines[7], lines[8]
    for s in range(count):
        near = a * x[s] + b * y[s] + c * z[s] - level
        far = near + length[s] * (a * u[s] + b * v[s] + c * w[s]) - about_far[s]
        near -= about_near[s]
        found[s] = near if near < far else far


@compiled("i8(f8[:,::1], i8, i8, f8[::1], f8[:,::1], f4[::1])")
def _left_over(lines: Array, count: int, but: np.intp, beyond: Array, kept: Array, room: Single) -> int:
    """Of the first shadows those that are not beyond, but one, and the room to them: moved to the front of `kept`."""
    left = 0
    for s in range(count):
        if s != but and not beyond[s] >= 0.0:
            for i in range(9):
                kept[i, left] = lines[i, s]
            room[left] = room[s]
            left += 1
    return left


@compiled("i8(f8[:,::1], f8[::1], f8[:,::1], f4[::1], f8, f8, f8[:,::1], f8[::1], f8[:,::1], f8[::1])")
def _until_beyond(
    lines: Array,
    start: Array,
    chord: Array,
    room: Single,
    keep_off: float,
    give: float,
    normals: Array,
    levels: Array,
    kept: Array,
    beyond: Array,
) -> int:
    """Half-spaces about one chord, into normals (k, 3) and levels (k,): so many. Overwrites what it is given to work
    with: room (n,), kept (9, n), beyond (n,)."""
    count, k, most, rest = lines.shape[1], 0, len(levels), lines
    while count > 0 and k < most:
        chosen = room[:count].argmin()
        normal, level = _support(rest, chosen, start, chord)
        level -= give * 2.0 ** (k // 8) * max(room[chosen] - keep_off, 0.0)
        normals[k, 0], normals[k, 1], normals[k, 2], levels[k] = normal[0], normal[1], normal[2], level
        world = level + normal[0] * start[0] + normal[1] * start[1] + normal[2] * start[2]
        _beyond(rest, count, normal, world, beyond)
        count = _left_over(rest, count, chosen, beyond, kept, room)
        rest = kept
        k += 1
    if count > 0:
        levels[most - 1] = -np.inf
    return k


@compiled("Tuple((f8[:,:,::1], f8[:,::1]))(f8[:,::1], f8[::1], f8[:,:,::1], f4[:,::1], f8, i8, f8, f8)")
def supporting(
    lines: Array, start: Array, chords: Array, room: Single, keep_off: float, most: int, give: float, farthest: float
) -> tuple[Array, Array]:
    """Half-spaces until every shadow is beyond one of them, about each of the chords (G, 2, 3), from the start: normals
    (G, k, 3) and levels (G, k), also from the start, for as many as any chord needs; those that one does not need are
    at `farthest`, and where `most` are not enough the last is at -inf. room (G, n) [m]: from the chords to the shadows;
    give: as `shadows.GIVE`."""
    normals, levels, needed = np.zeros((len(chords), most, 3)), np.full((len(chords), most), farthest), 0
    room, kept, beyond = room.copy(), np.empty_like(lines), np.empty(lines.shape[1])
    for group in range(len(chords)):
        a, b = normals[group], levels[group]
        count = _until_beyond(lines, start, chords[group], room[group], keep_off, give, a, b, kept, beyond)
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
    """Of how many groups, from the first on, the way is free, and a number."""
    for group in range(len(first)):
        until = first[group + 1] if group + 1 < len(first) else len(ends) - 1
        if not (room[group].min() > touching and np.isfinite(ends[first[group] : until + 1]).all()):
            return group
    return len(first)


@compiled("Tuple((f8[:,:,::1], f8[:,::1]))(f8[:,:,::1], f8[:,::1], i8[::1], f8[::1], f8[::1], f8[::1], f8, f8[::1])")
def about_periods(
    normals: Array,
    levels: Array,
    first: NDArray[np.int64],
    low: Array,
    high: Array,
    grown: Array,
    keep_off: float,
    measured: Array,
) -> tuple[Array, Array]:
    """Of half-spaces (G, k) of groups those of every period, (k+6, N, 3) and (k+6, N), for a body that keeps off what
    is there, and may have grown (N,), by where it is measured; and a box's faces (3,), (3,) from the start, as they
    are. Periods after the last group have the last one's."""
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
                kept += abs(normal[axis]) * measured[axis]
            b[i, k] = levels[group, i] - kept
        for axis in range(3):
            a[count + axis, k, axis], b[count + axis, k] = 1.0, high[axis]
            a[count + 3 + axis, k, axis], b[count + 3 + axis, k] = -1.0, -low[axis]
    return a, b

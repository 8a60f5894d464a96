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


ALTERNATIONS = 3  # between two segments, until their nearest points are known well enough


@compiled("f8[:,::1](f8[:,::1], i8[::1], f8[:,::1], f8[:,::1], f8[::1], f8, f8[::1], f8[::1], f8, f8)")
def behind(
    free: Array,
    first: NDArray[np.int64],
    ways: Array,
    turn: Array,
    at: Array,
    last: float,
    low: Array,
    high: Array,
    widening: float,
    wide: float,
) -> Array:
    """The lines of what is behind patches, each of the beams from its first one on (n,) of a grid, in directions (n, 3)
    from a point, turned by (3, 3): of those that come into a box between where they are free to and `last` m. Wide are
    they by so much, and so much more a metre."""
    beams = free.ravel()
    index, near, found = np.empty(len(first), np.int64), np.empty(len(first)), 0
    for k in range(len(first)):
        least = beams[first[k]]
        for beam in range(first[k] + 1, first[k + 1] if k + 1 < len(first) else len(beams)):
            least = min(least, beams[beam])
        if not least < last:
            continue
        enters, leaves = least, last
        for axis in range(3):
            way = turn[axis, 0] * ways[k, 0] + turn[axis, 1] * ways[k, 1] + turn[axis, 2] * ways[k, 2]
            one, other = (low[axis] - at[axis]) / way, (high[axis] - at[axis]) / way
            if one > other:
                one, other = other, one
            if one > enters:  # not if it is no number: beside that face for ever
                enters = one
            if other < leaves:
                leaves = other
        if enters <= leaves:
            index[found], near[found] = k, least
            found += 1
    lines = np.empty((9, found))
    for axis in range(3):
        for s in range(found):
            way = ways[index[s]]
            lines[3 + axis, s] = turn[axis, 0] * way[0] + turn[axis, 1] * way[1] + turn[axis, 2] * way[2]
            lines[axis, s] = at[axis] + near[s] * lines[3 + axis, s]
    for s in range(found):
        lines[6, s] = last - near[s]
        lines[7, s] = near[s] * widening + wide
        lines[8, s] = last * widening + wide
    return lines


@compiled("f8[:,::1](f8[:,::1], f8[::1], f8[:,::1], i8[::1])")
def rooms(lines: Array, start: Array, ends: Array, first: NDArray[np.int64]) -> Array:
    """About how near [m] each shadow is to any of the ends (N+1, 3), from the start, of the periods of each group,
    which begins with so many a period (G,): (G, n)."""
    n, periods = lines.shape[1], len(ends) - 1
    x, y, z = lines[0] - start[0], lines[1] - start[1], lines[2] - start[2]
    along_x, along_y, along_z, length, about = lines[3], lines[4], lines[5], lines[6], lines[7]
    outward = x * along_x + y * along_y + z * along_z
    square = x * x + y * y + z * z
    widening = (lines[8] - about) / np.maximum(length, TOUCHING)
    found = np.full((len(first), n), np.inf)
    for group in range(len(first)):
        until = first[group + 1] if group + 1 < len(first) else periods
        for end in range(first[group], until + 1):
            a, b, c = ends[end, 0], ends[end, 1], ends[end, 2]
            for s in range(n):
                away = a * along_x[s] + b * along_y[s] + c * along_z[s] - outward[s]
                t = min(max(away, 0.0), length[s])
                gap = square[s] - 2.0 * (a * x[s] + b * y[s] + c * z[s]) + a * a + b * b + c * c + t * (t - 2.0 * away)
                room = math.sqrt(max(gap, 0.0)) - about[s] - t * widening[s]
                found[group, s] = min(found[group, s], room)
    return found


@compiled("Tuple((UniTuple(f8, 3), f8))(f8[:], f8[::1], f8[:,::1])")
def _support(line: Array, start: Array, chord: Array) -> tuple[tuple[float, float, float], float]:
    """The unit normal from a chord (2, 3), from the start, towards a shadow (9,), and the level that it lies beyond."""
    near, along, length = line[:3] - start, line[3:6], line[6]
    way = chord[1] - chord[0]
    square, share = max((way * way).sum(), TOUCHING**2), 0.5
    place = there = near
    for _ in range(ALTERNATIONS):
        place = chord[0] + share * way
        there = near + min(max(((place - near) * along).sum(), 0.0), length) * along
        share = min(max(((there - chord[0]) * way).sum() / square, 0.0), 1.0)
    towards = there - place
    normal = towards / max(math.sqrt((towards * towards).sum()), TOUCHING)
    at_near = (normal * near).sum()
    at_far = at_near + length * (normal * along).sum()
    return (normal[0], normal[1], normal[2]), min(at_near - line[7], at_far - line[8])


@compiled("Tuple((f8[:,:,::1], f8[:,::1]))(f8[:,::1], f8[::1], f8[:,:,::1], f8[:,::1], f8, i8, f8, f8)")
def supporting(
    lines: Array, start: Array, chords: Array, room: Array, keep_off: float, most: int, give: float, farthest: float
) -> tuple[Array, Array]:
    """Half-spaces until every shadow is beyond one of them, about each of the chords (G, 2, 3), from the start: normals
    (k, G, 3) and levels (k, G), also from the start, for as many as any chord needs; those that one does not need are
    at `farthest`, and where `most` are not enough the last is at -inf. room (G, n) [m]: from the chords to the shadows;
    give: as `shadows.GIVE`."""
    n, needed = lines.shape[1], 0
    normals, levels = np.zeros((most, len(chords), 3)), np.full((most, len(chords)), farthest)
    index, left = np.empty(n, np.int64), np.empty(n)
    for group in range(len(chords)):
        count, k = n, 0
        index[:] = np.arange(n)
        left[:] = room[group]
        while count > 0 and k < most:
            chosen = left[:count].argmin()
            normal, level = _support(lines[:, index[chosen]], start, chords[group])
            level -= give * 2.0 ** (k // 8) * max(left[chosen] - keep_off, 0.0)
            normals[k, group], levels[k, group] = normal, level
            x, y, z = normal
            world = level + x * start[0] + y * start[1] + z * start[2]
            kept = 0
            for s in range(count):
                i = index[s]
                near = x * lines[0, i] + y * lines[1, i] + z * lines[2, i] - world
                far = near + lines[6, i] * (x * lines[3, i] + y * lines[4, i] + z * lines[5, i])
                if s != chosen and not (near >= lines[7, i] and far >= lines[8, i]):
                    index[kept], left[kept] = i, left[s]
                    kept += 1
            count = kept
            k += 1
        if count > 0:
            levels[most - 1, group] = -np.inf
        needed = max(needed, k)
    return normals[:needed], levels[:needed]

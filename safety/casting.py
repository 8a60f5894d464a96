"""Which shadows the patches of a range image cast into where a robot may be, compiled (`shadows.py`).

Shadows are told as `lines` (9, n), contiguous: their near ends x, y, z, the unit vectors along them x, y, z, their
length, and how wide they are about their near ends and their far ones, m.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from messaging.compiled import compiled

Array = NDArray[np.float64]
Single = NDArray[np.float32]

ROUNDING, WITHIN = 1e-4, 100.0  # m: by how much single precision may be off, of whatever is so near


@compiled("f8(f8)")
def rounding(extent: float) -> float:
    """How far [m] places may be off that are computed in single precision, from coordinates up to so many metres."""
    return ROUNDING * max(1.0, extent / WITHIN)


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
            least = ring[j]
            for beam in range(j + 1, min(j + each, columns)):
                least = least if least < ring[beam] else ring[beam]
            found[k] = least
            k += 1
    return found


@compiled("void(f4[:,::1], f4[::1], f4[:,::1], f4[:,::1], f4, f4[::1])")
def _room_inside(ways: Single, near: Single, turn: Single, faces: Single, last: np.float32, room: Single) -> None:
    """How far (n,) the near ends of rays in directions (3, n), turned by (3, 3), are from the faces (3, 2) of a box,
    and from being too far away; < 0: outside. From the sensor, which is at zero."""
    x, y, z = ways[0], ways[1], ways[2]  # all named one by one: so it becomes one instruction for many rays
    a, b, c, d, e, f = turn[0, 0], turn[0, 1], turn[0, 2], turn[1, 0], turn[1, 1], turn[1, 2]
    g, h, i = turn[2, 0], turn[2, 1], turn[2, 2]
    west, east, south, north, low, high = faces[0, 0], faces[0, 1], faces[1, 0], faces[1, 1], faces[2, 0], faces[2, 1]
    for k in range(len(room)):
        p, q, r, t = x[k], y[k], z[k], near[k]
        u, v, w, least = t * (a * p + b * q + c * r), t * (d * p + e * q + f * r), t * (g * p + h * q + i * r), last - t
        least = least if least < u - west else u - west
        least = least if least < east - u else east - u
        least = least if least < v - south else v - south
        least = least if least < north - v else north - v
        least = least if least < w - low else w - low
        room[k] = least if least < high - w else high - w


@compiled("i8[::1](f4[:,::1], f8[:,::1], f8[::1], f8, f8[::1], f8[::1], f4[::1])")
def _that_meet(
    ways: Single, turn: Array, at: Array, last: float, low: Array, high: Array, near: Single
) -> NDArray[np.int64]:
    """Which rays come into a box, or as near to it as rounding leads them aside, between `near` (n,) and last: those
    that begin in it, for it is convex and the sensor is inside. Where that is not, all may."""
    aside, faces, inside = rounding(last), np.empty((3, 2), np.float32), True
    for axis in range(3):
        inside &= low[axis] <= at[axis] <= high[axis]
        faces[axis, 0], faces[axis, 1] = low[axis] - at[axis] - aside, high[axis] - at[axis] + aside
    found, room, count = np.empty(len(near), np.int64), np.float32(last) - near, 0
    if inside:
        _room_inside(ways, near, turn.astype(np.float32), faces, np.float32(last), room)
    for k in range(len(near)):
        found[count] = k
        count += room[k] >= 0.0
    return found[:count]


@compiled("f8[:,::1](f4[:,::1], i8[::1], f4[:,::1], f8[:,::1], f8[::1], f8[:,:,::1], f8, f8, f8)")
def behind(
    free: Single,
    together: NDArray[np.int64],
    ways: Single,
    turn: Array,
    place: Array,
    boxes: Array,
    body: float,
    widening: float,
    wide: float,
) -> Array:
    """The lines of what is behind patches, as many beams together as each ring (E,) of the grid has it, in directions
    (3, n), turned by (3, 3), from a sensor that is mounted aside of a place (6,): of those that a body may touch which
    is so large, anywhere in the boxes (2, K, 3). Wide are they by so much, and so much more a metre."""
    at, low, high, square = np.empty(3), np.empty(3), np.empty(3), 0.0
    for axis in range(3):
        at[axis] = place[axis] + turn[axis, 0] * place[3] + turn[axis, 1] * place[4] + turn[axis, 2] * place[5]
        low[axis], high[axis] = boxes[0, :, axis].min(), boxes[1, :, axis].max()
        square += (max(at[axis] - low[axis], high[axis] - at[axis]) + body) ** 2
    last = (math.sqrt(square) + wide) / (1.0 - widening)  # no line of any width reaches into the boxes from beyond
    low -= body + last * widening + wide
    high += body + last * widening + wide
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

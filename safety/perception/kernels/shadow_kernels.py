"""Which shadows the patches of a range image cast into where a robot may be, compiled (`occluded_regions.py`).

Shadows are told as `lines` (11, n), contiguous, in single precision, from some place: their near ends x, y, z, the
unit vectors along them x, y, z, their length, how wide they are about their near ends and their far ones, m; and what
follows from these: how much each widens a metre, and how far off [m] it ends, no number where one of them is none.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from brakeline.safety.compilation import compiled
from brakeline.safety.filter.halfspaces import TOUCHING
from brakeline.safety.perception.kernels.proximity_kernels import least_ahead

Array = NDArray[np.float64]
Single = NDArray[np.float32]

BLOCK = 64  # rays
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
    ahead, spare, least = np.empty(2 * columns, np.float32), np.empty(2 * columns, np.float32), free[0].copy()
    for i in range(rings):
        each, ring = min(together[i], columns), free[i]
        count = (columns + each - 1) // each
        out = found[k : k + count]
        if each == 1:
            for j in range(count):
                out[j] = ring[j]
        else:
            for j in range(columns):
                ahead[j] = ring[j]
            ahead[columns : columns + each] = np.float32(np.inf)  # the last patch of a ring may be narrower
            least_ahead(ahead[: columns + each - 1], spare, least, each, 1)
            for j in range(count):
                out[j] = least[j * each]
        k += count
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
    signs = room.view(np.int32)
    for begin in range(0, len(near), BLOCK):
        block, all_ = signs[begin : begin + BLOCK], np.int32(-1)
        for k in range(len(block)):
            all_ &= block[k]
        if all_ < 0:  # of most blocks all begin outside
            continue
        for k in range(len(block)):
            found[count] = begin + k
            count += block[k] >= 0
    return found[:count]


@compiled("void(f4[::1], i8[::1], f4[::1])")
def _take(values: Single, index: NDArray[np.int64], found: Single) -> None:
    """The chosen ones."""
    for s in range(len(index)):
        found[s] = values[index[s]]


@compiled("void(f4[:,::1])")
def complete(lines: Single) -> None:
    """Tells what follows from the lines' first nine rows."""
    x, y, z, u, v, w = lines[0], lines[1], lines[2], lines[3], lines[4], lines[5]
    length, near, far, widening, extent = lines[6], lines[7], lines[8], lines[9], lines[10]
    least = np.float32(TOUCHING)
    for s in range(lines.shape[1]):
        widening[s] = (far[s] - near[s]) / (length[s] if length[s] > least else least)
        extent[s] = abs(x[s]) + abs(y[s]) + abs(z[s]) + near[s] + far[s]
        extent[s] += length[s] * (abs(u[s]) + abs(v[s]) + abs(w[s]))


@compiled("f8[:,::1](UniTuple(f8, 4))")
def _turned(attitude: tuple[float, float, float, float]) -> Array:
    """As `RangeImage.turn`."""
    a, b, c, d = attitude
    length = math.sqrt(a * a + b * b + c * c + d * d)
    w, x, y, z = a / length, b / length, c / length, d / length
    turn = np.empty((3, 3))
    turn[0, 0], turn[0, 1], turn[0, 2] = 1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)
    turn[1, 0], turn[1, 1], turn[1, 2] = 2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)
    turn[2, 0], turn[2, 1], turn[2, 2] = 2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)
    return turn


@compiled(
    "f4[:,::1](f4[:,::1], i8[::1], f4[:,::1], UniTuple(f8, 4), UniTuple(f8, 3), UniTuple(f8, 3), f8[:,:,::1], f8, f8,"
    " f8, f8[::1])"
)
def behind(
    free: Single,
    together: NDArray[np.int64],
    ways: Single,
    attitude: tuple[float, float, float, float],
    place: tuple[float, float, float],
    mount: tuple[float, float, float],
    boxes: Array,
    body: float,
    widening: float,
    wide: float,
    origin: Array,
) -> Single:
    """The lines, from the origin (3,), of what is behind patches, as many beams together as each ring (E,) of the grid
    has it, in directions (3, n) in the frame of a sensor with that attitude, mounted so far aside of a place: of those
    that a body may touch which is so large, anywhere in the boxes (2, K, 3). Wide are they by so much, and so much more
    a metre."""
    turn, at, low, high, square = _turned(attitude), np.empty(3), np.empty(3), np.empty(3), 0.0
    for axis in range(3):
        at[axis] = place[axis] + turn[axis, 0] * mount[0] + turn[axis, 1] * mount[1] + turn[axis, 2] * mount[2]
        low[axis], high[axis] = boxes[0, :, axis].min(), boxes[1, :, axis].max()
        square += (max(at[axis] - low[axis], high[axis] - at[axis]) + body) ** 2
    last = (math.sqrt(square) + wide) / (1.0 - widening)  # no line of any width reaches into the boxes from beyond
    low -= body + last * widening + wide
    high += body + last * widening + wide
    near = nearest_of_patches(free, together, ways.shape[1])
    index = _that_meet(ways, turn, at, last, low, high, near)
    n = len(index)
    lines, chosen, begin = np.empty((11, n), np.float32), np.empty((3, n), np.float32), np.empty(n, np.float32)
    for axis in range(3):
        _take(ways[axis], index, chosen[axis])
    _take(near, index, begin)
    x, y, z = chosen[0], chosen[1], chosen[2]
    for axis in range(3):
        a, b, c = np.float32(turn[axis, 0]), np.float32(turn[axis, 1]), np.float32(turn[axis, 2])
        off, begins, along = np.float32(at[axis] - origin[axis]), lines[axis], lines[3 + axis]
        for s in range(n):
            way = a * x[s] + b * y[s] + c * z[s]
            along[s] = way
            begins[s] = off + begin[s] * way
    most, wider, least_wide = np.float32(last), np.float32(widening), np.float32(wide)
    length, about_near, about_far = lines[6], lines[7], lines[8]
    for s in range(n):
        length[s] = most - begin[s]
        about_near[s] = begin[s] * wider + least_wide
        about_far[s] = most * wider + least_wide
    complete(lines)
    return lines

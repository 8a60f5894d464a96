"""Free space from a range image: what it does not show to be free lies in shadows, one for each patch (method §10).

The shadow of a patch is what is in it beyond F (`messaging/patches.py`). Thousands of them are kept off by a few
half-spaces a period: the one that supports the nearest shadow, then, of all that are not beyond it, the one that
supports the nearest of these, until none is left.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from messaging.patches import half_diagonal, seen_free
from messaging.range_images import RangeImage, directions
from messaging.shapes import FARTHEST
from safety.freespace import TOUCHING

Array = NDArray[np.float64]

PLANES = 32  # of a period at most: what needs more has no free space there
GIVE = 0.05  # of the room to a shadow, that is given up for fewer half-spaces; twice as much after every eight
SHARED = 0.6  # m of the nominal way, about, along which periods share half-spaces
FACES = np.vstack([np.eye(3), -np.eye(3)])  # of the room


@dataclass(frozen=True)
class Room:
    """A box (3,), (3,), world, that no plan leaves until so many s from now."""

    low: Array
    high: Array
    last: float


@dataclass(frozen=True)
class Shadows:
    """n of them, as `lines` (9, n) from their near ends to their far ones, world: `shading.py` says what a line is, and
    the hull of balls about both ends holds the shadow. room: all that come into it. speed [m/s]: whatever they hold may
    move as fast since `age` s ago."""

    lines: Array
    room: Room
    speed: float
    age: float


def prepare() -> None:
    """Compile what reads range images, or load it: before the first one is to be answered in time."""
    import messaging.nearby  # noqa: F401
    import safety.shading  # noqa: F401


def shadows(image: RangeImage, room: Room, body: float) -> Shadows:
    """All that is not known to be free and that a body of that radius [m], with its middle in the room, may touch."""
    from safety.shading import behind  # compiled

    elevations, free = seen_free(image)
    first, ways = _patches(tuple(elevations), free.shape[1])
    at, beside = image.sensor(), body + image.speed * (image.age + room.last)
    corners = np.maximum(np.abs(room.low - at), np.abs(room.high - at)) + beside
    about = half_diagonal(image) + image.angle_error
    within = (float(np.linalg.norm(corners)) + image.position_error) / (1.0 - about)
    beside += within * about + image.position_error
    low, high = room.low - beside, room.high + beside
    lines = behind(free, first, ways, image.turn, at, within, low, high, about, image.position_error)
    return Shadows(lines, room, image.speed, image.age)


@lru_cache(maxsize=16)
def _patches(elevations: tuple[float, ...], columns: int) -> tuple[NDArray[np.intp], Array]:
    """Where patches begin in a flat grid, and their middles (n, 3): near the poles several columns are one."""
    half = 0.5 * float(np.diff(elevations).max())  # the outermost rings may have been moved to the poles
    first, middles = [], []
    for ring, elevation in enumerate(elevations):
        together = int(1.0 / np.cos(max(abs(elevation) - half, 0.0)))
        begin = np.arange(0, columns, together)
        middle = 0.5 * (begin + np.minimum(begin + together, columns) - 1)
        first.append(ring * columns + begin)
        middles.append(directions(np.array([elevation]), columns, middle)[0])
    return np.concatenate(first), np.concatenate(middles)


def half_spaces(
    near: Shadows, start: Array, nominal: Array, keep_off: float, measured: Array, period: float
) -> tuple[Array, Array]:
    """As `freespace.half_spaces`: as many as any period needs, up to `PLANES`, and the room's faces. Those that a
    period does not need hold everywhere."""
    from safety.shading import rooms, supporting  # compiled

    N = len(nominal)
    normals = np.broadcast_to(FACES[:, None], (len(FACES), N, 3))
    offsets = np.broadcast_to(np.concatenate([near.room.high - start, start - near.room.low])[:, None], (len(FACES), N))
    if not near.lines.size:
        return normals, offsets
    ends = np.concatenate([np.zeros((1, 3)), nominal - start])
    first = _together(ends)
    finite = np.isfinite(ends).all(axis=1)
    room = rooms(near.lines, start, ends, first)
    free = (room.min(axis=1) > TOUCHING) & np.logical_and.reduceat(finite[1:] & finite[:-1], first)
    free = np.logical_and.accumulate(free)
    if not free[0]:
        return normals, np.full((len(FACES), N), -np.inf)
    last = int(free.sum())
    chords = np.stack([ends[first], ends[np.append(first[1:], N)]], axis=1)
    a, b = supporting(near.lines, start, chords[:last], room[:last], keep_off, PLANES, GIVE, FARTHEST)
    group = np.minimum(np.searchsorted(first, np.arange(N), side="right") - 1, last - 1)
    a, b = a[:, group], b[:, group]
    grown = near.speed * (near.age + period * np.arange(1, N + 1))
    b -= (grown + keep_off) * a.any(axis=2) + np.abs(a) @ measured
    return np.concatenate([a, normals]), np.concatenate([b, offsets])


def _together(ends: Array) -> NDArray[np.intp]:
    """The first periods of those that share half-spaces, for the nominal way hardly leads on in them."""
    way = np.cumsum(np.linalg.norm(ends[1:] - ends[:-1], axis=1))
    part = np.floor(way / SHARED)
    return np.flatnonzero(np.append(True, part[1:] != part[:-1]))

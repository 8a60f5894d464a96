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

PLANES = 32  # a period: what needs more has no free space there
GIVE = 0.05  # of the room to a shadow, that is given up for fewer half-spaces; twice as much after every eight
SHARED = 0.6  # m of the nominal way, about, along which periods share half-spaces
ROUNDING = 1e-4  # m
FACES = np.vstack([np.eye(3), -np.eye(3)])  # of the room


@dataclass(frozen=True)
class Room:
    """A box (3,), (3,), world, that no plan leaves until so many s from now."""

    low: Array
    high: Array
    last: float


@dataclass(frozen=True)
class Shadows:
    """n of them, from their near ends to their far ones: near, along (n, 3), world, along of unit length; length (n,);
    about_near, about_far (n,) m: the radius of balls about the ends, the hull of which holds the shadow. room: all that
    come into it. speed [m/s]: whatever they hold may move as fast since `age` s ago."""

    near: Array
    along: Array
    length: Array
    about_near: Array
    about_far: Array
    room: Room
    speed: float
    age: float

    def __len__(self) -> int:
        """How many half-spaces a period they are kept off by."""
        return PLANES + len(FACES)


def shadows(image: RangeImage, room: Room, body: float) -> Shadows:
    """All that is not known to be free and that a body of that radius [m], with its middle in the room, may touch."""
    elevations, free = seen_free(image)
    first, ways = _patches(tuple(elevations), free.shape[1])
    free = np.minimum.reduceat(free.ravel(), first)
    at, beside = image.sensor(), body + image.speed * (image.age + room.last)
    corners = np.maximum(np.abs(room.low - at), np.abs(room.high - at)) + beside
    about = half_diagonal(image) + image.angle_error
    within = (float(np.linalg.norm(corners)) + image.position_error) / (1.0 - about)
    near = free < within
    free, along = free[near], ways[near] @ image.turn.T
    widest = within * about + image.position_error
    near = _meets(at, along, free, within, room.low - beside - widest, room.high + beside + widest)
    free, along = free[near], along[near]
    return Shadows(
        at + free[:, None] * along,
        along,
        within - free,
        free * about + image.position_error,
        np.full(len(free), widest),
        room,
        image.speed,
        image.age,
    )


def _meets(at: Array, along: Array, first: Array, last: float, low: Array, high: Array) -> NDArray[np.bool_]:
    """Which rays from a point come into a box between a first and a last distance."""
    with np.errstate(divide="ignore", invalid="ignore"):
        sides = np.stack([(low - at) / along, (high - at) / along])
    enters, leaves = np.fmin(sides[0], sides[1]), np.fmax(sides[0], sides[1])
    return np.asarray(np.maximum(enters.max(axis=1), first) <= np.minimum(leaves.min(axis=1), last))


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
    """As `freespace.half_spaces`, `PLANES` of them a period; those that are not needed hold everywhere."""
    N = len(nominal)
    ends = np.concatenate([np.zeros((1, 3)), nominal - start])
    first = _together(ends)
    normals, offsets = np.zeros((len(near), N, 3)), np.full((len(near), N), FARTHEST)
    normals[PLANES:] = FACES[:, None]
    offsets[PLANES:] = np.concatenate([near.room.high - start, start - near.room.low])[:, None]
    if not len(near.near):
        return normals, offsets
    away = _room(near, start, ends)
    room = np.minimum.reduceat(np.minimum(away[1:], away[:-1]), first)
    free = np.logical_and.accumulate(room.min(axis=1) > TOUCHING)  # NaN is not, either
    if not free[0]:
        return normals, np.full((len(near), N), -np.inf)
    last = int(free.sum())
    chords = np.stack([ends[first], ends[np.append(first[1:], N)]], axis=1)
    a, b = _planes(near, start, chords[:last], room[:last], keep_off)
    group = np.minimum(np.searchsorted(first, np.arange(N), side="right") - 1, last - 1)
    a, b = a[:, group], b[:, group]
    grown = near.speed * (near.age + period * np.arange(1, N + 1))
    normals[:PLANES], offsets[:PLANES] = a, b - (grown + keep_off) * a.any(axis=2) - np.abs(a) @ measured
    return normals, offsets


def _together(ends: Array) -> NDArray[np.intp]:
    """The first periods of those that share half-spaces, for the nominal way hardly leads on in them."""
    way = np.cumsum(np.linalg.norm(ends[1:] - ends[:-1], axis=1))
    part = np.floor(way / SHARED)
    return np.flatnonzero(np.append(True, part[1:] != part[:-1]))


def _room(near: Shadows, start: Array, ends: Array) -> Array:
    """How near [m] each shadow is to each nominal end, at least: (N+1, n)."""
    points = near.near - start
    away, along = ends @ points.T, ends @ near.along.T
    outward = np.einsum("nd,nd->n", points, near.along)
    t = np.clip(along - outward, 0.0, near.length)
    square = np.einsum("nd,nd->n", points, points) - 2.0 * away + t * (t + 2.0 * (outward - along))
    square += np.einsum("qd,qd->q", ends, ends)[:, None]
    widening = (near.about_far - near.about_near) / np.maximum(near.length, TOUCHING)
    return np.asarray(np.sqrt(np.maximum(square, 0.0)) - near.about_near - t * widening)


def _planes(near: Shadows, start: Array, chords: Array, room: Array, keep_off: float) -> tuple[Array, Array]:
    """(PLANES, G, 3), (PLANES, G): half-spaces until every shadow is beyond one of them, about each of the chords
    (G, 2, 3); room (G, n) [m]: from these to the shadows."""
    G, each = len(room), np.arange(len(room))
    normals, offsets = np.zeros((PLANES, G, 3)), np.full((PLANES, G), FARTHEST)
    points = near.near - start
    # In single precision, by more than the error of which shadows are taken for wider.
    ends = np.stack([points, points + near.length[:, None] * near.along]).astype(np.float32).transpose(0, 2, 1)
    about = np.stack([near.about_near, near.about_far]).astype(np.float32)[:, None] + np.float32(ROUNDING)
    left, index = room.astype(np.float32), np.arange(len(points))
    for k in range(PLANES):
        chosen = left.argmin(axis=1)
        nearest = left[each, chosen]
        rest = nearest < np.inf
        if not rest.any():
            break
        which = index[chosen]
        normal, level = _support(near, points[which], which, chords)
        give = GIVE * 2.0 ** (k // 8)
        level -= ROUNDING + give * np.where(rest, np.maximum(nearest - keep_off, 0.0), 0.0)
        beyond = (normal.astype(np.float32) @ ends - about).min(axis=0) >= level[:, None].astype(np.float32)
        beyond[each, chosen] = True
        left[beyond] = np.inf
        normals[k, rest], offsets[k, rest] = normal[rest], level[rest]
        still = (left < np.inf).any(axis=0)
        if 2 * np.count_nonzero(still) < len(index):
            left, index, ends, about = left[:, still], index[still], ends[:, :, still], about[:, :, still]
            if not len(index):
                break
    offsets[-1, (left < np.inf).any(axis=1)] = -np.inf  # more of them than there is room for
    return normals, offsets


def _support(near: Shadows, points: Array, chosen: NDArray[np.intp], chords: Array) -> tuple[Array, Array]:
    """Unit normals (G, 3) from each chord (G, 2, 3) towards the shadow chosen for it, near ends (G, 3), and the level
    (G,) that the shadow lies beyond."""
    along, length = near.along[chosen], near.length[chosen]
    before, chord = chords[:, 0], chords[:, 1] - chords[:, 0]
    square = np.maximum(np.einsum("nd,nd->n", chord, chord), TOUCHING**2)
    share = np.full(len(chord), 0.5)
    for _ in range(3):  # the nearest points of two segments, by turns
        place = before + share[:, None] * chord
        t = np.clip(np.einsum("nd,nd->n", place - points, along), 0.0, length)
        there = points + t[:, None] * along
        share = np.clip(np.einsum("nd,nd->n", there - before, chord) / square, 0.0, 1.0)
    towards = there - place
    normal = towards / np.maximum(np.linalg.norm(towards, axis=1), TOUCHING)[:, None]
    at_near = np.einsum("nd,nd->n", normal, points)
    at_far = at_near + length * np.einsum("nd,nd->n", normal, along)
    return normal, np.minimum(at_near - near.about_near[chosen], at_far - near.about_far[chosen])

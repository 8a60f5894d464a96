"""How far a scan shows each gap between two beams to be free (docs/method.md §10).

Between two neighbouring beams Δ < 45° apart, free up to ρ from the sensor, everything nearer than

    F = min( ρ / (cos Δ + sin Δ tan(45° + Δ)),  W cos(45° + Δ) / sin Δ )

is free: from a point at d two edges of length W at right angles start, one of them at 45° or less to the beams' normal.
The gap there is at most d sin Δ wide; if that edge is long enough to leave it, it meets a beam at most at
d (cos Δ + sin Δ tan(45° + Δ)) from the sensor, where that is free if d < F.
Where that many beams in a row may be false, the edge must reach the next one: Δ is as much wider.
So a dropped beam costs little near by (2 m for W = 0.1 m), and a blind sector everything. A beam that returns from
where, by its neighbours, nothing can be is a ghost, and says nothing.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from brakeline.messaging.scan import Scan

Array = NDArray[np.float64]

WIDE = math.radians(3.0)  # of a gap in which nothing is taken for what is on both sides of it
NEARER = 0.15  # m between what two beams hit, if it is not one surface
STEEPEST = math.radians(89.0)  # 45° and a gap: beyond it an edge may lie along the beams


def gaps(scan: Scan) -> tuple[Array, Array, Array]:
    """Of each gap between two beams that say something: its first angle, its width [rad], and F [m] of the measured
    ranges, less their error. In the sensor's frame; all round."""
    return gaps_and_ways(scan)[:3]


def gaps_and_ways(scan: Scan) -> tuple[Array, Array, Array, NDArray[np.uint8]]:
    """The same, and which of the ways that a scan was followed by bounds what is behind F there; 0: none."""
    beams = np.flatnonzero(scan.known)
    angles = scan.angles[beams]
    ranges = np.maximum(np.minimum(scan.ranges[beams], scan.far) - scan.range_error, 0.0)
    if len(angles) > 2 * scan.doubt + 2:
        single = ~_lone(angles, ranges, scan)
        beams, angles, ranges = beams[single], angles[single], ranges[single]
    if not len(angles):
        return np.array([-math.pi]), np.array([2.0 * math.pi]), np.zeros(1), np.zeros(1, np.uint8)
    width = np.diff(angles, append=angles[0] + 2.0 * math.pi)
    doubt = min(scan.doubt, len(ranges))
    least = _least(ranges, range(-doubt, doubt + 2))
    free = _free(least, np.maximum(*_spans(width, doubt)), scan.least_width)
    if scan.tracks is None:
        return angles, width, free, np.zeros(len(free), np.uint8)
    return angles, width, free, _ways(scan.tracks.track_index[beams], ranges, width, doubt)


def _ways(which: NDArray[np.uint8], ranges: Array, width: Array, doubt: int) -> NDArray[np.uint8]:
    """Of each gap the way of the beams about it, if they have the same; where one of two hit something nearer, that
    one's. A wide gap has none: there may be something else in it."""
    same = np.ones(len(which), dtype=bool)
    for k in range(-doubt, doubt + 2):
        same &= np.roll(which, -k) == which
    after = np.roll(ranges, -1)
    if not doubt:
        nearer = np.where(ranges < after, which, np.roll(which, -1))
        which = np.where(np.abs(after - ranges) > NEARER, nearer, np.where(same, which, 0))
    else:
        which = np.where(same, which, 0)
    return np.where(width > WIDE, 0, which).astype(np.uint8)


def _spans(width: Array, doubt: int) -> tuple[Array, Array]:
    """Of each gap [rad], with so many more before it, and after it, all round."""
    before, after = width.copy(), width.copy()
    for k in range(1, doubt + 1):
        before += np.roll(width, k)
        after += np.roll(width, -k)
    return before, after


def _least(ranges: Array, places: range) -> Array:
    """The least of each beam's neighbours that are so many places on, all round."""
    before, count = max(0, -places[0]), len(ranges)
    turned = np.take(ranges, np.arange(-before, count + max(0, places[-1])), mode="wrap")
    least = turned[before + places[0] :][:count].copy()
    for k in places[1:]:
        np.minimum(least, turned[before + k :][:count], out=least)
    return least


def _free(least: Array, width: Array, least_width: float) -> Array:
    """F [m] of gaps of that width [rad] between beams that are free up to `least`."""
    steep = np.minimum(0.25 * math.pi + width, STEEPEST)
    free = np.minimum(
        least / (np.cos(width) + np.sin(width) * np.tan(steep)), least_width * np.cos(steep) / np.sin(width)
    )
    return np.where(steep < STEEPEST, free, 0.0)


def _lone(angles: Array, ranges: Array, scan: Scan) -> NDArray[np.bool_]:
    """Beams that return from where, by their neighbours and the least width, nothing can be: ghosts."""
    gap = np.diff(angles, append=angles[0] + 2.0 * math.pi)
    before, after = _spans(gap, scan.doubt)
    width = np.maximum(np.roll(gap, 1) + after, np.roll(before, 1) + gap)
    far = scan.doubt + 1
    beside = np.minimum(_least(ranges, range(-far, 0)), _least(ranges, range(1, far + 1)))
    return np.asarray(ranges + 2.0 * scan.range_error < _free(beside, width, scan.least_width))

"""How far a scan shows each gap between two beams to be free (docs/method.md §10).

Take two neighbouring beams that are Δ < 45° apart, both free up to ρ from the sensor. Everything in their gap that is
nearer than

    F = min( ρ / (cos Δ + sin Δ tan(45° + Δ)),  W cos(45° + Δ) / sin Δ )

is free. By assumption, two edges of length W at right angles start at each point of an obstacle's surface, and one of
them is within 45° of the beams' normal. At distance d the gap is at most d sin Δ wide. If the edge is long enough to
leave the gap, it meets a beam at most d (cos Δ + sin Δ tan(45° + Δ)) from the sensor, where the beam is free if d < F.

If `doubt` beams in a row may be false, the edge must reach the next beam, and Δ is wider by as many gaps. So a dropped
beam costs little nearby (2 m for W = 0.1 m), and a blind sector everything. A *ghost* is a return from where, by the
neighbouring beams, nothing can be. It counts as unknown.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from brakeline.messaging.obstacle import Array
from brakeline.messaging.scan import Scan

WIDE = math.radians(3.0)  # a wider gap may hide something else than the surfaces on both sides of it
SURFACE_STEP = 0.15  # m between two ranges: a larger step is between two surfaces
STEEPEST = math.radians(89.0)  # of 45° + Δ: beyond it, an edge may lie along the beams


def hits_of(scan: Scan) -> tuple[NDArray[np.intp], Array]:
    """Return the beams (k,) that hit something, and their ends (k, 2) [m], world."""
    at, heading = scan.sensor()
    beams = np.flatnonzero(scan.valid_beams & (scan.ranges < scan.far))
    angles = heading + scan.angles[beams]
    return beams, at + scan.ranges[beams, None] * np.column_stack([np.cos(angles), np.sin(angles)])


def gaps(scan: Scan) -> tuple[Array, Array, Array]:
    """Return the first angle [rad], the width [rad] and F [m] of each gap between two known beams, around the turn.

    Angles are in the sensor's frame. F is for the measured ranges minus their error.
    """
    return gaps_and_motions(scan)[:3]


def gaps_and_motions(scan: Scan) -> tuple[Array, Array, Array, NDArray[np.uint8]]:
    """Return `gaps(scan)`, and the motion of the surface behind each gap: its number in `BeamTracks.motions`, or 0."""
    beams = np.flatnonzero(scan.valid_beams)
    angles = scan.angles[beams]
    ranges = np.maximum(np.minimum(scan.ranges[beams], scan.far) - scan.range_error, 0.0)
    if len(angles) > 2 * scan.doubt + 2:
        real = ~_ghosts(angles, ranges, scan)
        beams, angles, ranges = beams[real], angles[real], ranges[real]
    if not len(angles):
        return np.array([-math.pi]), np.array([2.0 * math.pi]), np.zeros(1), np.zeros(1, np.uint8)
    width = np.diff(angles, append=angles[0] + 2.0 * math.pi)
    doubt = min(scan.doubt, len(ranges))
    least = _neighbour_minimum(ranges, range(-doubt, doubt + 2))
    wide = np.maximum(*_spans(width, doubt))
    free = _free_range(least, wide, scan.least_width)
    if scan.tracks is None:
        return angles, width, free, np.zeros(len(free), np.uint8)
    motion = _gap_motions(scan.tracks.track_index[beams], ranges, width, doubt)
    motion[free >= _hiding_range(wide, scan.least_width)] = 0  # what no beam hit may be before the surfaces
    return angles, width, free, motion


def _gap_motions(which: NDArray[np.uint8], ranges: Array, width: Array, doubt: int) -> NDArray[np.uint8]:
    """Return the motion of each gap, from those of its beams (R,).

    It is the beams' common motion, or that of the nearer surface. A wide gap has none: it may hide something else.
    """
    same = np.ones(len(which), dtype=bool)
    for k in range(-doubt, doubt + 2):
        same &= np.roll(which, -k) == which
    after = np.roll(ranges, -1)
    if not doubt:
        nearer = np.where(ranges < after, which, np.roll(which, -1))
        which = np.where(np.abs(after - ranges) > SURFACE_STEP, nearer, np.where(same, which, 0))
    else:
        which = np.where(same, which, 0)
    return np.where(width > WIDE, 0, which).astype(np.uint8)


def _spans(width: Array, doubt: int) -> tuple[Array, Array]:
    """Return the angles [rad] from each gap over `doubt` more gaps before it, and after it."""
    before, after = width.copy(), width.copy()
    for k in range(1, doubt + 1):
        before += np.roll(width, k)
        after += np.roll(width, -k)
    return before, after


def _neighbour_minimum(ranges: Array, offsets: range) -> Array:
    """Return the least range of each beam's neighbours at the offsets, around the turn."""
    before, count = max(0, -offsets[0]), len(ranges)
    wrapped = np.take(ranges, np.arange(-before, count + max(0, offsets[-1])), mode="wrap")
    least = wrapped[before + offsets[0] :][:count].copy()
    for k in offsets[1:]:
        np.minimum(least, wrapped[before + k :][:count], out=least)
    return least


def _free_range(least: Array, width: Array, least_width: float) -> Array:
    """Return F [m] of gaps of a width [rad] between beams that are free up to `least` [m]."""
    steep = np.minimum(0.25 * math.pi + width, STEEPEST)
    seen = least / (np.cos(width) + np.sin(width) * np.tan(steep))
    return np.where(steep < STEEPEST, np.minimum(seen, _hiding_range(width, least_width)), 0.0)


def _hiding_range(width: Array, least_width: float) -> Array:
    """Return the range [m] from which on an obstacle may lie unseen between the beams of gaps of a width [rad]."""
    return least_width * np.cos(np.minimum(0.25 * math.pi + width, STEEPEST)) / np.sin(width)


def _ghosts(angles: Array, ranges: Array, scan: Scan) -> NDArray[np.bool_]:
    gap = np.diff(angles, append=angles[0] + 2.0 * math.pi)
    before, after = _spans(gap, scan.doubt)
    width = np.maximum(np.roll(gap, 1) + after, np.roll(before, 1) + gap)
    far = scan.doubt + 1
    beside = np.minimum(_neighbour_minimum(ranges, range(-far, 0)), _neighbour_minimum(ranges, range(1, far + 1)))
    return np.asarray(ranges + 2.0 * scan.range_error < _free_range(beside, width, scan.least_width))

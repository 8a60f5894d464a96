"""Find where something that a scan does not see may come out from behind what it sees (docs/method.md §10).

A shadow begins behind a near surface. Whatever is in the shadow must cross the line along its edge before the sensor
sees any part of it. The line goes from the near surface to what the sensor sees beyond. So everything that may come out
is within speed times time of that line.

Something at least as large as a disc of radius R needs room to hide. Let D be the distance from the line's near end to
the nearest fully hidden disc. Take a point of the line at a distance r < D from that end. It is at least D - r from
every hidden disc, so whatever comes out there has moved by D - r already. From the line's point at D, the way to this
point is no longer than D - r. So whatever comes out at r gets no farther than something that starts at D, and only the
part of the line from D on counts.

The method assumes that a surface stays in place until everything behind it has come out.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

SECTORS = 360  # of a turn
SECTOR = 2.0 * math.pi / SECTORS  # rad
DISC_SECTORS = 30  # on either side of a disc's center: what the scan sees there must be in front of the disc
SLIT = 0.1  # m: a smaller step between two ranges lets nothing through


@dataclass(frozen=True)
class OcclusionExits:
    """Edges of shadows where something may come out."""

    before: NDArray[np.intp]  # (e,) number of the gap with the near surface
    angle: Array  # (e,) [rad] in the sensor's frame
    # near, far: (e,) [m], distances from the sensor to the first and the last point where something may come out
    near: Array
    far: Array

    def take(self, index: NDArray[np.bool_]) -> OcclusionExits:
        return OcclusionExits(self.before[index], self.angle[index], self.near[index], self.far[index])


def occlusion_exits(angles: Array, width: Array, free: Array, radius: float) -> OcclusionExits:
    """Return the exits between gaps (`scan_coverage.gaps`). radius: of the smallest thing that may hide [m]."""
    after = np.roll(free, -1)
    edge = np.flatnonzero(np.abs(after - free) > SLIT)
    nearer = free[edge] < after[edge]
    before = np.where(nearer, edge, (edge + 1) % len(free))
    near, far = np.minimum(free[edge], after[edge]), np.maximum(free[edge], after[edge])
    exits = OcclusionExits(before, angles[edge] + width[edge], near, far)
    if radius <= 0.0 or not len(edge):
        return exits
    nearest = _nearest_hidden(exits, _hiding_distance(angles, width, free, radius), radius)
    exits = OcclusionExits(before, exits.angle, near + nearest, far)
    return exits.take(exits.near < exits.far)


def _hiding_distance(angles: Array, width: Array, free: Array, radius: float) -> Array:
    """Return the least distance [m] from the sensor to the center of a fully hidden disc, in each sector."""
    least = minimum_by_sector(angles, width, free, SECTORS)
    away = np.arange(-DISC_SECTORS, DISC_SECTORS + 1)
    off = (np.abs(away) + 0.5) * SECTOR  # largest angle from the center to the middle beam of that sector
    beside = least[(np.arange(SECTORS)[:, None] + away) % SECTORS]
    across = beside * np.sin(off)
    within = np.sqrt(np.maximum(radius * radius - across * across, 0.0))
    distance = np.where(across <= radius, beside * np.cos(off) + within, radius / np.sin(off))
    return np.asarray(distance.max(axis=1))


def _nearest_hidden(exits: OcclusionExits, hiding: Array, radius: float) -> Array:
    """Return D (e,) [m] of each edge, from the hiding distances of the sectors [m]."""
    middles = SECTOR * (np.arange(SECTORS) + 0.5)
    aside = np.abs(np.mod(middles - exits.angle[:, None] + math.pi, 2.0 * math.pi) - math.pi)
    aside = np.maximum(aside - 0.5 * SECTOR, 0.0)
    near = exits.near[:, None]
    reach = np.maximum(hiding, near * np.cos(aside))
    square = reach * reach + near * near - 2.0 * reach * near * np.cos(aside)
    return np.asarray(np.maximum(np.sqrt(np.maximum(square, 0.0)).min(axis=1) - radius, 0.0))


def minimum_by_sector(angles: Array, width: Array, free: Array, sectors: int) -> Array:
    """Return the least free range (sectors,) [m] of the gaps that meet each sector of a turn, from angle 0 on."""
    least = np.full(sectors, np.inf)
    per = sectors / (2.0 * math.pi)
    # A gap that ends on the border of two sectors meets both, in spite of rounding.
    first = np.floor(angles * per - 1e-9).astype(int)
    last = np.floor((angles + width) * per + 1e-9).astype(int)
    for step in range(int((last - first).max()) + 1):
        within = first + step <= last
        np.minimum.at(least, (first[within] + step) % sectors, free[within])
    return least

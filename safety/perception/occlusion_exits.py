"""Where somebody whom a sensor does not see may come out from behind something that it does.

Behind a near surface a shadow begins. Whoever is in it passes the line at its edge, from the near surface to what is
seen beyond, before any part of him is where the sensor sees: all that may come is within speed times time of that line.

And who is at least as large as a disc of radius R needs room to hide. Let D be how far the nearest such disc, hidden
all over, is from the line's near end. A point of the line, r from that end, is no nearer to it than D - r, so what
comes by that point is no farther than who goes from the line's point at D straight off: the line counts from D on.

What stands before the hidden one is taken to stay until it has come out.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

PARTS = 360  # of a turn
PART = 2.0 * math.pi / PARTS  # rad
BESIDE = 30  # parts to either side of a disc's middle that it is looked for in
SLIT = 0.1  # m: nobody gets through what is narrower, and hardly into it


@dataclass(frozen=True)
class Outlets:
    """Edges (e,) of shadows: before, the gap of what is near there; angle [rad] in the sensor's frame; near, far [m],
    from the sensor to where somebody may pass."""

    before: NDArray[np.intp]
    angle: Array
    near: Array
    far: Array

    def take(self, index: NDArray[np.bool_]) -> Outlets:
        """The chosen ones."""
        return Outlets(self.before[index], self.angle[index], self.near[index], self.far[index])


def outlets(angles: Array, width: Array, free: Array, radius: float) -> Outlets:
    """Of gaps as `brakeline.safety.perception.scan_coverage.gaps` has them; radius [m]: of the smallest that may
    hide, 0: of any size."""
    after = np.roll(free, -1)
    edge = np.flatnonzero(np.abs(after - free) > SLIT)
    nearer = free[edge] < after[edge]
    before = np.where(nearer, edge, (edge + 1) % len(free))
    near, far = np.minimum(free[edge], after[edge]), np.maximum(free[edge], after[edge])
    found = Outlets(before, angles[edge] + width[edge], near, far)
    if radius <= 0.0 or not len(edge):
        return found
    found = Outlets(before, found.angle, near + _room(found, _hiding(angles, width, free, radius), radius), far)
    return found.take(found.near < found.far)


def _hiding(angles: Array, width: Array, free: Array, radius: float) -> Array:
    """How far [m] from the sensor the middle of a disc of which nothing is seen is at least, in each part of a turn."""
    least = least_of(angles, width, free, PARTS)
    away = np.arange(-BESIDE, BESIDE + 1)
    off = (np.abs(away) + 0.5) * PART  # at most, from the middle to the beam in the middle of that part
    beside = least[(np.arange(PARTS)[:, None] + away) % PARTS]
    across = beside * np.sin(off)
    within = np.sqrt(np.maximum(radius * radius - across * across, 0.0))
    there = np.where(across <= radius, beside * np.cos(off) + within, radius / np.sin(off))
    return np.asarray(there.max(axis=1))


def _room(edges: Outlets, hiding: Array, radius: float) -> Array:
    """How far [m] all that hides is from each edge's near end, at least: (e,)."""
    middles = PART * (np.arange(PARTS) + 0.5)
    aside = np.abs(np.mod(middles - edges.angle[:, None] + math.pi, 2.0 * math.pi) - math.pi)
    aside = np.maximum(aside - 0.5 * PART, 0.0)
    near = edges.near[:, None]
    reach = np.maximum(hiding, near * np.cos(aside))
    square = reach * reach + near * near - 2.0 * reach * near * np.cos(aside)
    return np.asarray(np.maximum(np.sqrt(np.maximum(square, 0.0)).min(axis=1) - radius, 0.0))


def least_of(angles: Array, width: Array, free: Array, parts: int) -> Array:
    """The least free range (parts,) of the gaps that meet each of so many equal parts of a turn, from angle 0 on."""
    least = np.full(parts, np.inf)
    per = parts / (2.0 * math.pi)
    first = np.floor(angles * per - 1e-9).astype(int)
    last = np.floor((angles + width) * per + 1e-9).astype(int)
    for step in range(int((last - first).max()) + 1):
        within = first + step <= last
        np.minimum.at(least, (first[within] + step) % parts, free[within])
    return least

"""Free space from a scan, as convex cells that hold all that is not known to be free (method §10).

Between two neighbouring beams Δ < 45° apart, free up to ρ from the sensor, everything nearer than

    F = min( ρ / (cos Δ + sin Δ tan(45° + Δ)),  W cos(45° + Δ) / sin Δ )

is free: from a point at d two edges of length W at right angles start, one of them at 45° or less to the beams' normal.
The gap there is at most d sin Δ wide; if that edge is long enough to leave it, it meets a beam at most at
d (cos Δ + sin Δ tan(45° + Δ)) from the sensor, where that is free if d < F.
So a dropped beam costs little near by (2 m for W = 0.1 m), and a blind sector everything. A beam that returns from
where, by its neighbours, nothing can be is a ghost, and says nothing. Beyond F, and behind every hit, nothing is known:
occupied. Neighbouring gaps of about the same F make a cell, the convex hull of their near ends and their far ones: a
wall within reach is a handful of cells.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from messaging.scans import Scan
from safety.freespace import TOUCHING, roomiest

Array = NDArray[np.float64]

SPAN = math.radians(12.0)  # of a cell, about
STEEPEST = math.radians(89.0)  # 45° and a gap: beyond it an edge may lie along the beams
JUMP = 0.1  # m between the F of two gaps that do not share a cell
WIDEST = math.radians(15.0)  # a wider gap is cut into several of the same F, so that hulls stay near the arcs


@dataclass(frozen=True)
class Cells:
    """n convex cells: corners (n, V, 2), world [m], repeated where there are fewer; error (n, V) m, how far each may be
    off; speed [m/s]: whatever they hold may move as fast since `age` s ago."""

    corners: Array
    error: Array
    speed: float = 0.0
    age: float = 0.0

    def __len__(self) -> int:
        return len(self.corners)

    def take(self, index: NDArray[np.intp]) -> Cells:
        """The chosen ones."""
        return Cells(self.corners[index], self.error[index], self.speed, self.age)


def gaps(scan: Scan) -> tuple[Array, Array, Array]:
    """Of each gap between two beams that say something: its first angle, its width [rad], and F [m] of the measured
    ranges, less their error. In the sensor's frame; all round."""
    known = scan.known
    angles = scan.angles[known]
    ranges = np.maximum(np.minimum(scan.ranges[known], scan.far) - scan.range_error, 0.0)
    if len(angles) > 2 * scan.doubt + 2:
        lone = _lone(angles, ranges, scan)
        angles, ranges = angles[~lone], ranges[~lone]
    if not len(angles):
        return np.array([-math.pi]), np.array([2.0 * math.pi]), np.zeros(1)
    width = np.diff(angles, append=angles[0] + 2.0 * math.pi)
    least = np.minimum(ranges, np.roll(ranges, -1))
    for k in range(1, min(scan.doubt, len(ranges)) + 1):
        least = np.minimum(least, np.minimum(np.roll(ranges, k), np.roll(ranges, -1 - k)))
    return angles, width, _free(least, width, scan.least_width)


def _free(least: Array, width: Array, least_width: float) -> Array:
    """F [m] of gaps of that width [rad] between beams that are free up to `least`."""
    steep = np.minimum(0.25 * math.pi + width, STEEPEST)
    free = np.minimum(
        least / (np.cos(width) + np.sin(width) * np.tan(steep)), least_width * np.cos(steep) / np.sin(width)
    )
    return np.where(steep < STEEPEST, free, 0.0)


def _lone(angles: Array, ranges: Array, scan: Scan) -> NDArray[np.bool_]:
    """Beams that return from where, by their neighbours and the least width, nothing can be: ghosts."""
    width = (np.roll(angles, -1) - np.roll(angles, 1)) % (2.0 * math.pi)
    beside = np.minimum(np.roll(ranges, 1), np.roll(ranges, -1))
    for k in range(2, scan.doubt + 2):
        beside = np.minimum(beside, np.minimum(np.roll(ranges, k), np.roll(ranges, -k)))
    return np.asarray(ranges + 2.0 * scan.range_error < _free(beside, width, scan.least_width))


def cells(scan: Scan, within: float) -> Cells:
    """All that is not known to be free within so many m of the sensor."""
    angles, width, free = gaps(scan)
    parts = np.maximum(np.ceil(width / WIDEST).astype(int), 1)
    if (parts > 1).any():
        each = np.repeat(np.arange(len(angles)), parts)
        number = np.arange(len(each)) - np.repeat(np.cumsum(parts) - parts, parts)
        width = width[each] / parts[each]
        angles, free = angles[each] + number * width, free[each]
    near = free < within
    if not near.any():
        return Cells(np.zeros((0, 1, 2)), np.zeros((0, 1)), scan.speed, scan.age)
    begins = np.append(True, ~near[:-1] | (np.abs(np.diff(free)) > JUMP))
    run = np.cumsum(begins) - 1
    along = angles - angles[begins][run]
    angles, width, free = angles[near], width[near], free[near]
    _, cell = np.unique(np.stack([run[near], along[near] // SPAN]), axis=1, return_inverse=True)
    cell = cell.ravel()
    start = np.searchsorted(cell, np.arange(int(cell.max()) + 1))
    slot = np.arange(len(cell)) - start[cell]
    at, heading = scan.sensor()
    # near ends at both sides of the gap, far ones so that the chord between them is beyond `within`
    far = np.maximum(free, within) / np.cos(0.5 * width)
    sides = heading + np.stack([angles, angles + width, angles, angles + width], axis=1)
    reach = np.stack([free, free, far, far], axis=1)
    points = at + reach[..., None] * np.stack([np.cos(sides), np.sin(sides)], axis=-1)  # (gaps, 4, 2)
    error = scan.position_error + scan.heading_error * (reach + math.hypot(*scan.mount))
    filled = (
        np.zeros((len(start), int(slot.max()) + 1), dtype=int) + start[:, None]
    )  # an empty slot repeats the cell's first gap
    filled[cell, slot] = np.arange(len(cell))
    return Cells(points[filled].reshape(len(start), -1, 2), error[filled].reshape(len(start), -1), scan.speed, scan.age)


def half_spaces(
    near: Cells, start: Array, nominal: Array, keep_off: float, measured: Array, period: float
) -> tuple[Array, Array]:
    """As `freespace.half_spaces`. A normal points to a cell's closest corner; its level is the least over all corners,
    so that the whole hull is beyond it, whatever the normal."""
    ends = np.concatenate([np.zeros((1, 2)), nominal - start])
    places = np.empty((2 * len(nominal) + 1, 2))
    places[::2] = ends
    places[1::2] = 0.5 * (ends[1:] + ends[:-1])
    corners = near.corners - start
    away = corners[:, None] - places[:, None]  # (n, q, V, 2)
    distance = np.einsum("nqvd,nqvd->nqv", away, away)
    closest = distance.argmin(axis=2)
    towards = np.take_along_axis(away, closest[:, :, None, None], axis=2)[:, :, 0]
    gap = np.sqrt(np.einsum("nqd,nqd->nq", towards, towards))
    unit = towards / np.maximum(gap, TOUCHING)[..., None]
    level = (unit @ corners.transpose(0, 2, 1) - near.error[:, None]).min(axis=2)
    level[~(gap > TOUCHING)] = -np.inf
    choice = roomiest(unit, level, ends)
    each = np.arange(len(choice))[:, None]
    normal = unit[each, choice]
    grown = near.speed * (near.age + period * np.arange(1, len(ends)))
    offset = level[each, choice] - grown - keep_off - np.abs(normal) @ measured
    return normal, np.where(np.isnan(offset), -np.inf, offset)

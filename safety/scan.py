"""Free space from a scan, as convex cells that hold all that is not known to be free (method §10).

Up to F from the sensor a gap between two beams is free (`messaging/gaps.py`). Beyond F, and behind every hit, nothing
is known: occupied. Neighbouring gaps of about the same F make a cell, the convex hull of their near ends and their far
ones: a wall within reach is a handful of cells.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from messaging.gaps import gaps as gaps
from messaging.scans import Scan
from safety.freespace import TOUCHING, roomiest

Array = NDArray[np.float64]

SPAN = math.radians(12.0)  # of a cell, about
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
    run, span = run[near], along[near] // SPAN  # neither falls within the other
    first = np.append(True, (run[1:] != run[:-1]) | (span[1:] != span[:-1]))
    cell, start = np.cumsum(first) - 1, np.flatnonzero(first)
    slot = np.arange(len(cell)) - start[cell]
    at, heading = scan.sensor()
    # near ends at both sides of the gap, far ones so that the chord between them is beyond `within`
    far = np.maximum(free, within) / np.cos(0.5 * width)
    sides = heading + np.stack([angles, angles + width], axis=1)
    towards = np.stack([np.cos(sides), np.sin(sides)], axis=-1)
    reach = np.stack([free, free, far, far], axis=1)
    points = at + reach[..., None] * np.concatenate([towards, towards], axis=1)  # (gaps, 4, 2)
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
    square = np.einsum("nvd,nvd->nv", corners, corners)  # of a corner's distance to a place, less that of the place
    closest = (square[..., None] - 2.0 * (corners @ places.T)).argmin(axis=1)
    towards = corners[np.arange(len(corners))[:, None], closest] - places  # (n, q, 2)
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

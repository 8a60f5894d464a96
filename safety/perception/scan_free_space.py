"""Free space from a scan, as convex cells that hold all that is not known to be free (docs/method.md §10).

Up to F from the sensor a gap between two beams is free (`safety/perception/scan_coverage.py`). Beyond F, and behind
every hit, nothing
is known: occupied. Neighbouring gaps of about the same F make a cell, the convex hull of their near ends and their far
ones: a wall within reach is a handful of cells.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from brakeline.messaging.scan import Scan
from brakeline.safety.filter.halfspaces import TOUCHING, roomiest
from brakeline.safety.perception import occlusion_exits
from brakeline.safety.perception.scan_coverage import gaps as gaps
from brakeline.safety.perception.scan_coverage import gaps_and_ways

Array = NDArray[np.float64]

SPAN = math.radians(12.0)  # of a cell, about
JUMP = 0.1  # m between the F of two gaps that do not share a cell
WIDEST = math.radians(15.0)  # a wider gap is cut into several of the same F, so that hulls stay near the arcs


@dataclass(frozen=True)
class OccupiedCells:
    """n convex cells: corners (n, V, 2), world [m], repeated where there are fewer; error (n, V) m, how far each may be
    off; ways (n, 4): the motion since, `age` s ago, see `BeamTracks`; speed [m/s]: the fastest."""

    corners: Array
    error: Array
    ways: Array
    speed: float = 0.0
    age: float = 0.0

    def __len__(self) -> int:
        return len(self.corners)

    def take(self, index: NDArray[np.intp]) -> OccupiedCells:
        """The chosen ones."""
        return OccupiedCells(self.corners[index], self.error[index], self.ways[index], self.speed, self.age)

    def beside(self, others: OccupiedCells) -> OccupiedCells:
        """These and those, of one scan."""
        widest = max(self.corners.shape[1], others.corners.shape[1])
        parts = []
        for occupied_cells in (self, others):
            slots = np.minimum(np.arange(widest), max(occupied_cells.corners.shape[1] - 1, 0))  # the last one repeated
            parts.append((occupied_cells.corners[:, slots], occupied_cells.error[:, slots], occupied_cells.ways))
        joined = [np.concatenate(pair) for pair in zip(*parts, strict=True)]
        return OccupiedCells(joined[0], joined[1], joined[2], self.speed, self.age)


def occupied_cells(scan: Scan, within: float) -> OccupiedCells:
    """All that is not known to be free within so many m of the sensor, and where somebody may come out of it."""
    found = gaps_and_ways(scan)
    known = _cells(scan, within, *found)
    return known if scan.tracks is None else known.beside(_edges(scan, within, *found))


def _cells(
    scan: Scan, within: float, angles: Array, width: Array, free: Array, way: NDArray[np.uint8]
) -> OccupiedCells:
    parts = np.maximum(np.ceil(width / WIDEST).astype(int), 1)
    if (parts > 1).any():
        each = np.repeat(np.arange(len(angles)), parts)
        number = np.arange(len(each)) - np.repeat(np.cumsum(parts) - parts, parts)
        width = width[each] / parts[each]
        angles, free, way = angles[each] + number * width, free[each], way[each]
    near = free < within
    if not near.any():
        return OccupiedCells(np.zeros((0, 1, 2)), np.zeros((0, 1)), np.zeros((0, 4)), scan.speed, scan.age)
    begins = np.append(True, ~near[:-1] | (np.abs(np.diff(free)) > JUMP) | (way[1:] != way[:-1]))
    run = np.cumsum(begins) - 1
    along = angles - angles[begins][run]
    angles, width, free, way = angles[near], width[near], free[near], way[near]
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
    corners, error = points[filled].reshape(len(start), -1, 2), error[filled].reshape(len(start), -1)
    return OccupiedCells(corners, error, ways_of(scan)[way[start]], scan.speed, scan.age)


def ways_of(scan: Scan) -> Array:
    """(K+1, 4): the ways of what was hit, the first of them that of whatever may go anywhere."""
    anywhere = np.array([[0.0, 0.0, scan.speed, 0.0]])
    return anywhere if scan.tracks is None else np.concatenate([anywhere, scan.tracks.motions])


def _edges(
    scan: Scan, within: float, angles: Array, width: Array, free: Array, way: NDArray[np.uint8]
) -> OccupiedCells:
    """Where what is hidden behind something followed may come out: beside it, as fast as anything may (`hidden.py`)."""
    outlets = occlusion_exits.outlets(angles, width, free, scan.least_radius)
    chosen = (way[outlets.before] > 0) & (outlets.near < within)
    at, heading = scan.sensor()
    side = heading + outlets.angle[chosen]
    reach = np.column_stack([outlets.near, outlets.far])[chosen]
    corners = at + reach[..., None] * np.column_stack([np.cos(side), np.sin(side)])[:, None]
    error = scan.position_error + scan.heading_error * (reach + math.hypot(*scan.mount))
    return OccupiedCells(corners, error, np.tile(ways_of(scan)[0], (len(reach), 1)), scan.speed, scan.age)


def shows_free(scan: Scan, place: Array) -> bool:
    """Is a place (2,), world, among what the scan shows to be free, or on its edge?"""
    at, heading = scan.sensor()
    east, north = place - at
    angles, width, free = gaps(scan)
    here = (math.atan2(north, east) - heading - angles) % math.tau <= width
    return bool(math.hypot(east, north) <= free[here].min(initial=math.inf))


def half_spaces(
    near: OccupiedCells, start: Array, nominal: Array, keep_off: float, measured: Array, period: float
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
    t = near.age + period * np.arange(len(ends))
    goes = np.einsum("nkd,nd->nk", normal, near.ways[:, :2])
    offset = level[each, choice] + np.minimum(goes * t[:-1], goes * t[1:])
    offset -= near.ways[:, 2:3] * t[1:] + 0.5 * near.ways[:, 3:] * t[1:] ** 2
    offset -= keep_off + np.abs(normal) @ measured
    return normal, np.where(np.isnan(offset), -np.inf, offset)

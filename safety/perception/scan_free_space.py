"""Free space from a scan: convex cells hold everything that the scan does not show to be free (docs/method.md §10).

A gap between two beams is free up to F from the sensor (`scan_coverage.py`). Beyond F, and behind every hit, nothing is
known, so it counts as occupied. A cell is the convex hull of the near ends and far ends of neighbouring gaps with about
the same F. A wall within reach is a handful of cells.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from brakeline.messaging.obstacle import Array
from brakeline.messaging.scan import Scan
from brakeline.safety.filter.halfspaces import TOUCHING, viewpoints
from brakeline.safety.perception.occlusion_exits import occlusion_exits
from brakeline.safety.perception.scan_coverage import WIDE, gaps, gaps_and_motions

SPAN = math.radians(12.0)  # of a cell, about
JUMP = 0.1  # m between the F of two gaps in different cells
WIDEST = math.radians(15.0)  # a wider gap is split into several of the same F, so that hulls stay close to the arcs
VELOCITY, ERROR, ACCELERATION = slice(0, 2), slice(2, 3), slice(3, 4)  # columns of a motion, as in `BeamTracks.motions`


@dataclass(frozen=True)
class OccupiedCells:
    """n convex cells that may be occupied."""

    corners: Array  # (n, V, 2) [m], world; the last corner is repeated in cells with fewer
    error: Array  # (n, V) largest position error of each corner [m]
    motions: Array  # (n, 4) motion of the cell's contents since the scan, as a row of `BeamTracks.motions`
    speed: float = 0.0  # largest speed of anything [m/s]
    age: float = 0.0  # time since the scan [s]

    def __len__(self) -> int:
        return len(self.corners)

    def take(self, index: NDArray[np.intp]) -> OccupiedCells:
        return OccupiedCells(self.corners[index], self.error[index], self.motions[index], self.speed, self.age)

    def joined(self, others: OccupiedCells) -> OccupiedCells:
        """Return these cells and others of the same scan."""
        most = max(self.corners.shape[1], others.corners.shape[1])
        parts = []
        for cells in (self, others):
            slots = np.minimum(np.arange(most), max(cells.corners.shape[1] - 1, 0))
            parts.append((cells.corners[:, slots], cells.error[:, slots], cells.motions))
        corners, error, motions = (np.concatenate(pair) for pair in zip(*parts, strict=True))
        return OccupiedCells(corners, error, motions, self.speed, self.age)


def occupied_cells(scan: Scan, within: float) -> OccupiedCells:
    """Return everything within a distance [m] of the sensor that may be occupied, or that something may come out of."""
    gaps = gaps_and_motions(scan)
    cells = _unseen_cells(scan, within, *gaps)
    return cells if scan.tracks is None else cells.joined(_exit_cells(scan, within, *gaps))


def _unseen_cells(
    scan: Scan, within: float, angles: Array, width: Array, free: Array, motion: NDArray[np.uint8]
) -> OccupiedCells:
    """Return the cells of what the scan does not show to be free."""
    parts = np.maximum(np.ceil(width / WIDEST).astype(int), 1)
    if (parts > 1).any():
        gap = np.repeat(np.arange(len(angles)), parts)
        number = np.arange(len(gap)) - np.repeat(np.cumsum(parts) - parts, parts)
        width = width[gap] / parts[gap]
        angles, free, motion = angles[gap] + number * width, free[gap], motion[gap]
    near = free < within
    if not near.any():
        return OccupiedCells(np.zeros((0, 1, 2)), np.zeros((0, 1)), np.zeros((0, 4)), scan.speed, scan.age)
    # A run of gaps ends where F jumps or the motion changes. A run is split into cells of `SPAN`.
    begins = np.append(True, ~near[:-1] | (np.abs(np.diff(free)) > JUMP) | (motion[1:] != motion[:-1]))
    run = np.cumsum(begins) - 1
    along = angles - angles[begins][run]
    angles, width, free, motion = angles[near], width[near], free[near], motion[near]
    run, span = run[near], along[near] // SPAN
    first = np.append(True, (run[1:] != run[:-1]) | (span[1:] != span[:-1]))
    cell, start = np.cumsum(first) - 1, np.flatnonzero(first)
    slot = np.arange(len(cell)) - start[cell]
    at, heading = scan.sensor()
    far = np.maximum(free, within) / np.cos(0.5 * width)  # so that the chord between two far ends is beyond `within`
    sides = heading + np.stack([angles, angles + width], axis=1)
    towards = np.stack([np.cos(sides), np.sin(sides)], axis=-1)
    reach = np.stack([free, free, far, far], axis=1)
    points = at + reach[..., None] * np.concatenate([towards, towards], axis=1)  # (gaps, 4, 2)
    error = _corner_error(scan, reach)
    # An empty slot repeats the cell's first gap.
    members = np.zeros((len(start), int(slot.max()) + 1), dtype=int) + start[:, None]
    members[cell, slot] = np.arange(len(cell))
    corners, error = points[members].reshape(len(start), -1, 2), error[members].reshape(len(start), -1)
    return OccupiedCells(corners, error, possible_motions(scan)[motion[start]], scan.speed, scan.age)


def _corner_error(scan: Scan, reach: Array) -> Array:
    """Return the largest position error [m] of points at a distance [m] from the sensor."""
    return np.asarray(scan.position_error + scan.heading_error * (reach + math.hypot(*scan.mount)))


def possible_motions(scan: Scan) -> Array:
    """Return the motions (K+1, 4) of the scan's surfaces. The first is that of a surface that may go anywhere."""
    anywhere = np.array([[0.0, 0.0, scan.speed, 0.0]])
    return anywhere if scan.tracks is None else np.concatenate([anywhere, scan.tracks.motions])


def _exit_cells(
    scan: Scan, within: float, angles: Array, width: Array, free: Array, motion: NDArray[np.uint8]
) -> OccupiedCells:
    """Return the edges of tracked surfaces where something hidden may come out, at the largest speed."""
    exits = occlusion_exits(angles, width, free, scan.least_radius)
    exits = exits.take((motion[exits.before] > 0) & (exits.near < within))
    at, heading = scan.sensor()
    side = heading + exits.angle
    reach = np.column_stack([exits.near, exits.far])
    corners = at + reach[..., None] * np.column_stack([np.cos(side), np.sin(side)])[:, None]
    motions = np.tile(possible_motions(scan)[0], (len(reach), 1))
    return OccupiedCells(corners, _corner_error(scan, reach), motions, scan.speed, scan.age)


def shows_free(scan: Scan, position: Array) -> bool:
    """Return whether the scan shows a position (2,), world, to be free. The edge of free space counts."""
    at, heading = scan.sensor()
    east, north = position - at
    angles, width, free = gaps(scan)
    here = (math.atan2(north, east) - heading - angles) % math.tau <= width
    return bool(math.hypot(east, north) <= free[here].min(initial=math.inf))


def blind_near(scan: Scan, position: Array, within: float) -> bool:
    """Return whether a direction without information may come within a distance [m] of a position (2,), world."""
    at, heading = scan.sensor()
    angles, width, free = gaps(scan)
    wide = np.flatnonzero(width > WIDE)
    if not len(wide):
        return False
    rays = [np.linspace(angles[i], angles[i] + width[i], math.ceil(width[i] / WIDE) + 1) for i in wide]
    side = heading + np.concatenate(rays)
    towards = np.stack([np.cos(side), np.sin(side)], axis=1)
    reach = np.maximum(towards @ (position - at), np.repeat(free[wide], [len(ray) for ray in rays]))
    away = np.linalg.norm(at + reach[:, None] * towards - position, axis=1)
    return bool((away - _corner_error(scan, reach) <= within).any())


def half_spaces(
    near: OccupiedCells, start: Array, nominal: Array, keep_off: float, measured: Array, period: float
) -> tuple[Array, Array]:
    """Return half-spaces like `halfspaces.half_spaces`; period: duration of a period [s].

    A normal points to a cell's closest corner. Its level is the least over all corners, each minus its error, so the
    whole hull is beyond it for any normal.
    """
    from brakeline.safety.filter.kernels import shape_kernels

    ends, places = viewpoints(start, nominal)
    corners = near.corners - start
    square = np.einsum("nvd,nvd->nv", corners, corners)
    # |corner - place|² without the term |place|², which is the same for all corners
    closest = (square[..., None] - 2.0 * (corners @ places.T)).argmin(axis=1)
    towards = corners[np.arange(len(corners))[:, None], closest] - places  # (n, 2N+1, 2)
    gap = np.sqrt(np.einsum("nqd,nqd->nq", towards, towards))
    unit = towards / np.maximum(gap, TOUCHING)[..., None]
    level = (unit @ corners.transpose(0, 2, 1) - near.error[:, None]).min(axis=2)
    level[~(gap > TOUCHING)] = -np.inf
    choice = shape_kernels.roomiest_planes(unit, level, ends)
    cell = np.arange(len(choice))[:, None]
    normal = unit[cell, choice]
    t = near.age + period * np.arange(len(ends))
    drift = np.einsum("nkd,nd->nk", normal, near.motions[:, VELOCITY])
    offset = level[cell, choice] + np.minimum(drift * t[:-1], drift * t[1:])
    offset -= near.motions[:, ERROR] * t[1:] + 0.5 * near.motions[:, ACCELERATION] * t[1:] ** 2
    offset -= keep_off + np.abs(normal) @ measured
    return normal, np.where(np.isnan(offset), -np.inf, offset)

"""Memory of the free space near a robot, as cells of a grid: for directions in which its sensor never sees.

`FanMemory` keeps the last dozen scans. A robot that turns to and fro soon forgets what is behind it, and cannot move
any more. In this memory, a cell of the grid stays free while it is near the robot. So use it only where nothing
moves. A cell counts as free if a single scan shows that all of it is free, even with the errors of that scan. At the
start, an operator may state that a disc about the robot is free. Nothing else makes a cell free.

The memory forgets a cell after the robot has driven `KEPT`. Meanwhile, the poses must stay within their stated errors.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from brakeline.messaging.obstacle import Array
from brakeline.messaging.scan import Scan
from brakeline.safety.perception.scan_coverage import hits_of
from brakeline.safety.perception.visibility_memory import STEP, FanMemory

CELLS = 128  # along each side of the grid
CELLS_PER_RADIUS = 10  # of the body's disc
KEPT = 40.0  # radii of the body that a robot may drive, or its rim turn, until a cell is forgotten
NEIGHBOURS = np.stack(np.meshgrid((-1, 0, 1), (-1, 0, 1)), axis=-1).reshape(-1, 2)  # of a cell, and itself


class GridMemory(FanMemory):
    """The free space near one robot in a world in which nothing moves. A scan with a speed frees nothing."""

    def __init__(self, footprint: float, stated: float) -> None:
        """footprint: radius of the body's disc [m]; stated: of the disc that is free at the start [m]."""
        self._cell = footprint / CELLS_PER_RADIUS  # m, edge
        self._spacing = math.sqrt(0.5) * self._cell + 0.5 * STEP  # from a cell's middle to points between its samples
        super().__init__(footprint)
        self._footprint, self._stated = footprint, stated

    def reset(self) -> None:
        """Forget all space, also what was stated: nobody knows where the robot was at the start."""
        super().reset()
        self._stated = self._way = 0.0
        self._shown_at = np.full((CELLS, CELLS), -math.inf)  # m, the way at which each cell was last shown to be free
        self._corner = np.zeros(2, dtype=int)  # numbers of the lowest cell
        self._counted: tuple[float, float, float] | None = None  # the pose up to which the way is counted

    def fill(self, scan: Scan | None, elapsed: float) -> Scan:
        if scan is not None:
            self._follow(scan)
        return super().fill(scan, elapsed)

    def _follow(self, scan: Scan) -> None:
        """Move the grid to the robot, and count its way."""
        at = np.array(scan.pose[:2])
        corner = np.floor(at / self._cell).astype(int) - CELLS // 2
        rows, columns = (np.arange(CELLS) + shift for shift in corner - self._corner)
        inside = [(index >= 0) & (index < CELLS) for index in (rows, columns)]
        moved = np.full_like(self._shown_at, -math.inf)
        moved[np.ix_(*inside)] = self._shown_at[np.ix_(rows[inside[0]], columns[inside[1]])]
        self._shown_at, self._corner = moved, corner
        if self._counted is None:
            self._counted = scan.pose
            if not scan.speed:
                away = np.linalg.norm(self._middles() - at, axis=-1)
                self._shown_at[away <= self._stated - scan.position_error - self._spacing] = 0.0
            return
        turn = abs(math.remainder(scan.pose[2] - self._counted[2], math.tau))
        distance = math.dist(scan.pose[:2], self._counted[:2])
        if distance > 2.0 * scan.position_error or turn > 2.0 * scan.heading_error:  # less may be errors; counts later
            self._way, self._counted = self._way + distance + self._footprint * turn, scan.pose

    def _middles(self) -> Array:
        """Return the middles (CELLS, CELLS, 2) of the cells [m]."""
        numbers = np.stack(np.meshgrid(*(np.arange(CELLS) + low for low in self._corner), indexing="ij"), axis=-1)
        return np.asarray(self._cell * (numbers + 0.5))

    def _store(self, scan: Scan) -> None:
        if scan.speed:
            return
        exact = replace(scan, position_error=0.0, heading_error=0.0)  # who reads a filled scan subtracts its errors
        shown = self._shown_free(self._as_stored(scan), scan.age, self._middles(), exact, self._spacing)
        self._shown_at[shown] = self._way
        self._forget_hits(scan)

    def _forget_hits(self, scan: Scan) -> None:
        """Forget the cells at the scan's hits, and their neighbours: something may have come there."""
        _, points = hits_of(scan)
        points = points[np.linalg.norm(points - np.asarray(scan.pose[:2]), axis=1) > self._footprint]
        cells = np.floor(points / self._cell).astype(int) - self._corner
        around = (cells[:, None] + NEIGHBOURS).reshape(-1, 2)
        row, column = around[((around >= 0) & (around < CELLS)).all(axis=1)].T
        self._shown_at[row, column] = -math.inf

    def _free_along(self, scan: Scan, beams: NDArray[np.bool_]) -> Array:
        """Return how far [m] the beams pass through free cells, and the body's own place, by the measured pose.

        Unlike in `FanMemory`, the errors of this scan's pose are not subtracted.
        """
        at, heading = scan.sensor()
        away = STEP * np.arange(1, round(0.5 * CELLS * self._cell / STEP) + 1)
        turned = heading + scan.angles[beams]
        points = at + away[:, None, None] * np.stack([np.cos(turned), np.sin(turned)], axis=1)  # (S, B, 2)
        cells = np.floor(points / self._cell).astype(int) - self._corner
        inside = ((cells >= 0) & (cells < CELLS)).all(axis=-1)
        row, column = np.moveaxis(np.clip(cells, 0, CELLS - 1), -1, 0)
        free = inside & (self._way - self._shown_at[row, column] <= KEPT * self._footprint)
        own = self._footprint - scan.position_error - STEP
        free |= np.linalg.norm(points - np.asarray(scan.pose[:2]), axis=-1) <= own
        return STEP * np.where(free.all(axis=0), len(away), free.argmin(axis=0))

"""Ways through an arena on a grid: each cell's distance from the obstacles, the best way from every cell to a goal."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import label
from scipy.sparse import csr_array
from scipy.sparse.csgraph import dijkstra

from messaging.shapes import Obstacle, Shapes

Array = NDArray[np.float64]

CELL = 0.05  # m, edge of a cell
CELLS_PER_SIDE = 110  # at most; wider rooms get wider cells
STEPS = ((1, 0), (0, 1), (1, 1), (1, -1))  # half of the eight neighbours; the others are these reversed


class ClearanceMap:
    """Distance from every cell's centre to the nearest obstacle: `clearance` (n, n), m, first index along x."""

    def __init__(self, obstacles: Sequence[Obstacle], bounds: tuple[float, float]) -> None:
        self.low = bounds[0]
        width = bounds[1] - bounds[0]
        self.side = min(round(width / CELL), CELLS_PER_SIDE)
        self.cell = width / self.side
        centres = self.low + self.cell * (np.arange(self.side) + 0.5)
        points = np.stack(np.meshgrid(centres, centres, indexing="ij"), axis=-1)
        self.centres: Array = points.reshape(-1, 2)
        self.clearance: Array = _nearest(Shapes.of(obstacles, dim=2), self.centres).reshape(self.side, self.side)

    def index(self, points: Array) -> NDArray[np.intp]:
        """Cells of points (..., 2), the outermost ones for points beyond the walls: (..., 2)."""
        cells = np.floor((points - self.low) / self.cell).astype(np.intp)
        return np.clip(cells, 0, self.side - 1)

    def at(self, points: Array) -> Array:
        """Clearance of the cells that hold points (..., 2), in m."""
        cells = self.index(points)
        return np.asarray(self.clearance[cells[..., 0], cells[..., 1]])

    def connected(self, start: Sequence[float], goal: Sequence[float], clearance: float) -> bool:
        """Whether a disc of radius `clearance` (m) can go from start to goal.

        Between two cells h = cell·√2 apart, both at least c from a point, the way is at least √(c² − h²/4) from it.
        """
        least = float(np.hypot(clearance, self.cell / np.sqrt(2.0)))
        regions, _ = label(self.clearance >= least, structure=np.ones((3, 3)))
        ends = self.index(np.array([start, goal]))
        first, last = regions[ends[:, 0], ends[:, 1]]
        return bool(first == last and first > 0)


def _nearest(shapes: Shapes, points: Array) -> Array:
    """Distances (p,) from points (p, 2) to the nearest shape: `Shapes.distance`, ten times faster for many points."""
    least = np.full(len(points), np.inf)
    x, y = np.ascontiguousarray(points.T)
    for (cx, cy), axes, (half_x, half_y), rho in zip(shapes.center, shapes.axes, shapes.half, shapes.rho, strict=True):
        along = np.abs((x - cx) * axes[0, 0] + (y - cy) * axes[1, 0]) - half_x
        across = np.abs((x - cx) * axes[0, 1] + (y - cy) * axes[1, 1]) - half_y
        np.minimum(least, np.hypot(np.maximum(along, 0.0), np.maximum(across, 0.0)) - rho, out=least)
    return np.asarray(np.maximum(least, 0.0))


class Routes:
    """The best way from every cell to one goal, as Dijkstra's algorithm finds it.

    A way costs its length times 1 + `AVOIDANCE`·(lack/comfort)², where lack is what the clearance misses to `comfort`;
    cells that the body does not fit in cost `BLOCKED` times their length, so that a robot that strayed into one gets
    out again. One run serves the whole episode: whoever leaves the way follows the one from the new cell.
    """

    AVOIDANCE = 30.0
    BLOCKED = 1e4

    def __init__(self, grid: ClearanceMap, goal: Sequence[float], footprint: float, comfort: float) -> None:
        """footprint, comfort: m; distances from the axle to an obstacle that are possible, and that are liked."""
        self.grid = grid
        side = grid.side
        lack = np.clip((comfort - grid.clearance) / (comfort - footprint), 0.0, 1.0)
        weight = np.where(grid.clearance > footprint, 1.0 + self.AVOIDANCE * lack**2, self.BLOCKED)
        ids = np.arange(side * side).reshape(side, side)
        rows, columns, costs = [], [], []
        for dx, dy in STEPS:
            here = (slice(0, side - dx), slice(max(0, -dy), side - max(0, dy)))
            there = (slice(dx, side), slice(max(0, dy), side + min(0, dy)))
            rows.append(ids[here].ravel())
            columns.append(ids[there].ravel())
            costs.append((0.5 * np.hypot(dx, dy) * grid.cell * (weight[here] + weight[there])).ravel())
        graph = csr_array(
            (np.concatenate(costs), (np.concatenate(rows), np.concatenate(columns))), shape=(side**2, side**2)
        )
        cell = grid.index(np.asarray(goal, dtype=np.float64))
        self._goal = int(ids[cell[0], cell[1]])
        _, before = dijkstra(graph, directed=False, indices=self._goal, return_predecessors=True)
        self._next = before

    def way(self, position: Array, length: float) -> Array:
        """Centres of the next cells from a position (2,) on towards the goal, up to `length` m: (k, 2), k ≥ 1."""
        x, y = self.grid.index(position)
        cell = int(x) * self.grid.side + int(y)
        cells = [cell]
        while cell != self._goal and len(cells) * self.grid.cell < length:
            cell = int(self._next[cell])
            cells.append(cell)
        return np.asarray(self.grid.centres[cells])

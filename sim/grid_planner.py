"""Plan paths on a grid: the clearance of every cell, and the best path from every cell to a goal.

Only the functions that need SciPy import it, because the import takes a third of the time to start an actor.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import cached_property
from itertools import product
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from brakeline.messaging.obstacle import Array, Obstacle, Shapes

if TYPE_CHECKING:
    from scipy.sparse import csr_array

CELL = {2: 0.05, 3: 0.625}  # m, edge of a cell in the plane and in space
MOST_CELLS = {2: 110**2, 3: 65_536}  # larger rooms have larger cells


class ClearanceMap:
    """The distance from the centre of every cell to the nearest obstacle."""

    def __init__(self, obstacles: Sequence[Obstacle], bounds: Sequence[tuple[float, float]]) -> None:
        """bounds: (low, high) of each of the d = 2 or 3 axes [m].

        Cells are cubes that fill the first axis. On the other axes, the last cell may end half a cell from the bound.
        """
        widths = [high - low for low, high in bounds]
        self.dim = len(bounds)
        self.low: Array = np.array([low for low, _ in bounds])
        cell: float = max(CELL[self.dim], (math.prod(widths) / MOST_CELLS[self.dim]) ** (1.0 / self.dim))
        self.cell: float = widths[0] / round(widths[0] / cell)  # m, edge of a cell
        self.shape = tuple(round(width / self.cell) for width in widths)
        self._axes = [low + self.cell * (np.arange(n) + 0.5) for low, n in zip(self.low, self.shape, strict=True)]
        self._shapes = Shapes.of(obstacles, dim=self.dim)

    @cached_property
    def clearance(self) -> Array:
        """The distances [m], with one index for each axis, x first."""
        return nearest_distances(self._shapes, self.centres).reshape(self.shape)

    @cached_property
    def centres(self) -> Array:
        """The centres (cells, d) [m]."""
        return np.stack(np.meshgrid(*self._axes, indexing="ij"), axis=-1).reshape(-1, self.dim)

    def index(self, points: Array) -> NDArray[np.intp]:
        """Return the cells (..., d) of points (..., d); points beyond the walls belong to the outermost cells."""
        cells = np.floor((points - self.low) / self.cell).astype(np.intp)
        return np.clip(cells, 0, np.array(self.shape) - 1)

    def number(self, points: Array) -> NDArray[np.intp]:
        """Return the cells of points (..., d) as indices (...) into `centres`."""
        return np.asarray(np.ravel_multi_index(tuple(np.moveaxis(self.index(points), -1, 0)), self.shape))

    def at(self, points: Array) -> Array:
        """Return the clearance (...) [m] of the cells that hold points (..., d)."""
        return np.asarray(self.clearance[tuple(np.moveaxis(self.index(points), -1, 0))])

    def interpolate(self, values: Array, points: Array) -> Array:
        """Interpolate values of the cells (with the shape of `clearance`) linearly at points (..., d): (...)."""
        from scipy.ndimage import map_coordinates

        coordinates = np.moveaxis((points - self.low) / self.cell - 0.5, -1, 0)
        return np.asarray(map_coordinates(values, coordinates, order=1, mode="nearest"))

    def connected(self, start: Sequence[float], goal: Sequence[float], clearance: float) -> bool:
        """Return whether a disc (ball) of radius `clearance` [m] can go from start to goal.

        If two cell centres h = cell·√d apart are both at least c from a point, then the line between them is at least
        √(c² − h²/4) from it.
        """
        from brakeline.sim.kernels.arena_kernels import connected

        least = float(np.hypot(clearance, 0.5 * self.cell * np.sqrt(self.dim)))
        neighbours = np.array([step for step in product((-1, 0, 1), repeat=self.dim) if any(step)])
        first, last = self.index(np.array([start, goal]))
        size = np.array(self.shape)
        return connected(*self._shapes.parts, self.low, self.cell, size, neighbours, first, last, least)


def nearest_distances(shapes: Shapes, points: Array) -> Array:
    """Return the distance (k,) [m] from each point (k, d) to the nearest shape; 0 inside one."""
    from brakeline.sim.kernels import arena_kernels

    return arena_kernels.nearest_distances(*shapes.parts, np.ascontiguousarray(points))


class Routes:
    """The best paths from every cell to one goal, by Dijkstra's algorithm.

    A path costs its length times 1 + `AVOIDANCE`·lack², where lack in [0, 1] is the share of the wanted clearance that
    is missing. Cells that the body does not fit in cost `BLOCKED` times their length, so that a robot in one of them
    still finds a way out. One run of the algorithm is enough for an episode: a robot that has left its path follows the
    path from its new cell.
    """

    AVOIDANCE = 30.0
    BLOCKED = 1e4

    def __init__(self, grid: ClearanceMap, goal: Sequence[float], footprint: float, wanted: float) -> None:
        """footprint, wanted: m, the least possible and the wanted distance from the robot's position to an obstacle."""
        from scipy.ndimage import minimum_filter
        from scipy.sparse.csgraph import dijkstra

        self.grid = grid
        lack = np.clip((wanted - grid.clearance) / (wanted - footprint), 0.0, 1.0)
        free = grid.clearance > footprint
        weight = np.where(free, 1.0 + self.AVOIDANCE * lack**2, self.BLOCKED)
        self._goal = int(grid.number(np.asarray(goal, dtype=np.float64)))
        cost, before = dijkstra(_graph(weight, grid.cell), directed=False, indices=self._goal, return_predecessors=True)
        self._next = before  # for each cell, the next one on the path to the goal; the search began at the goal
        self._cost = cost.reshape(grid.shape)
        # The interpolation also reads the cells beside free ones. Their cost must not be that of a path through an
        # obstacle.
        nearby = minimum_filter(self._cost, size=3) + grid.cell
        self._cost[~free] = np.minimum(self._cost, nearby)[~free]

    def cost_to_go(self, points: Array) -> Array:
        """Return the cost (...) [m] of the best path from points (..., d) to the goal, interpolated between cells."""
        return self.grid.interpolate(self._cost, points)

    def path(self, position: Array, length: float) -> Array:
        """Return the centres (k, d), k ≥ 1, of the cells from a position (d,) to the goal, up to `length` m."""
        cell = int(self.grid.number(position))
        cells = [cell]
        while cell != self._goal and len(cells) * self.grid.cell < length:
            cell = int(self._next[cell])
            cells.append(cell)
        return np.asarray(self.grid.centres[cells])


def _graph(weight: Array, cell: float) -> csr_array:
    """Return the costs of the edges between neighbouring cells: the length, times the mean weight of both cells.

    Each edge occurs once, in one of its directions.
    """
    from scipy.sparse import csr_array

    ids = np.arange(weight.size).reshape(weight.shape)
    rows, columns, costs = [], [], []
    for step in product((-1, 0, 1), repeat=weight.ndim):
        if step <= (0,) * weight.ndim:  # the cell itself, or the other direction of an edge
            continue
        here = tuple(slice(max(0, -d), n - max(0, d)) for d, n in zip(step, weight.shape, strict=True))
        there = tuple(slice(max(0, d), n - max(0, -d)) for d, n in zip(step, weight.shape, strict=True))
        rows.append(ids[here].ravel())
        columns.append(ids[there].ravel())
        costs.append((0.5 * np.linalg.norm(step) * cell * (weight[here] + weight[there])).ravel())
    pairs = (np.concatenate(rows), np.concatenate(columns))
    return csr_array((np.concatenate(costs), pairs), shape=(weight.size, weight.size))

"""The distance to a goal around discs, on a grid."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import product

import numpy as np

from brakeline import Obstacle
from examples.foreign.adapter import Adapter, Array

CELL = 0.25  # edge of a cell, and extra clearance from the discs, as shares of the body's radius
AHEAD = 6  # cells
DISC_COST = 50.0  # factor on the length of a path within a disc: from there a path leads out
NEIGHBOURS = [offset for offset in product((-1, 0, 1), repeat=2) if any(offset)]


class DistanceField:
    """The distance [m] to the goal from every cell of the room.

    D(cell) = min over its neighbours of D(neighbour) + step, repeated until nothing changes.
    """

    def __init__(self, adapter: Adapter, obstacles: Sequence[Obstacle], goal: Sequence[float]) -> None:
        body = adapter.robot.footprint
        self.low, self.cell = -adapter.half_width, CELL * body
        self.count = count = round(2.0 * adapter.half_width / self.cell)
        axis = self.low + self.cell * (np.arange(count) + 0.5)
        x, y = np.meshgrid(axis, axis, indexing="ij")
        cost = np.ones((count, count))
        for o in obstacles:
            if o.kind == "cylinder":
                reach = o.size[0] + o.margin + body + self.cell
                cost[np.hypot(x - o.position[0], y - o.position[1]) < reach] = DISC_COST
        self.distance = np.full((count, count), np.inf)
        self.distance[self._cell(np.asarray(goal))] = 0.0
        before = np.zeros(0)
        while not np.array_equal(before, self.distance):
            before = self.distance.copy()
            for offset in NEIGHBOURS:
                step = self.cell * float(np.hypot(*offset)) * cost
                np.minimum(self.distance, self._neighbour(offset) + step, out=self.distance)

    def ahead(self, position: Array) -> Array:
        """Return a point some cells ahead on the shortest path."""
        at = self._cell(position)
        for _ in range(AHEAD):
            near = [(at[0] + dx, at[1] + dy) for dx, dy in NEIGHBOURS]
            inside = [cell for cell in near if min(cell) >= 0 and max(cell) < self.count]
            at = min([at, *inside], key=lambda cell: float(self.distance[cell]))
        return self.low + self.cell * (np.array(at) + 0.5)

    def _cell(self, point: Array) -> tuple[int, int]:
        x, y = np.clip(((point - self.low) / self.cell).astype(int), 0, self.count - 1)
        return int(x), int(y)

    def _neighbour(self, offset: tuple[int, int]) -> Array:
        """Return the distance of each cell's neighbour at an offset."""
        padded = np.pad(self.distance, 1, constant_values=np.inf)
        x, y = 1 + offset[0], 1 + offset[1]
        return padded[x : x + self.count, y : y + self.count]

"""Ways to a goal around discs, on a grid."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import product

import numpy as np

from brakeline.messaging.obstacle import CYLINDER, Obstacle
from examples.foreign.adapter import Adapter, Array

CELL = 0.25  # of the body's radius: edge of a cell, and what is kept to the discs
AHEAD = 6  # cells
DEAR = 50.0  # times as long is a way through a disc: from within one there is a way out too
SIDES = [side for side in product((-1, 0, 1), repeat=2) if any(side)]


class Ways:
    """The distance [m] to the goal from every cell of the room, by relaxation until nothing changes:
    D(cell) = min over its neighbours of D(neighbour) + step, dear within a disc."""

    def __init__(self, adapter: Adapter, obstacles: Sequence[Obstacle], goal: Sequence[float]) -> None:
        body = adapter.robot.footprint
        self.low, self.cell = -adapter.room, CELL * body
        self.count = count = round(2.0 * adapter.room / self.cell)
        axis = self.low + self.cell * (np.arange(count) + 0.5)
        x, y = np.meshgrid(axis, axis, indexing="ij")
        dear = np.ones((count, count))
        for o in obstacles:
            if o.kind == CYLINDER:
                reach = o.size[0] + o.margin + body + self.cell
                dear[np.hypot(x - o.position[0], y - o.position[1]) < reach] = DEAR
        self.far = np.full((count, count), np.inf)
        self.far[self._cell(np.asarray(goal))] = 0.0
        before = np.zeros(0)
        while not np.array_equal(before, self.far):
            before = self.far.copy()
            for side in SIDES:
                step = self.cell * float(np.hypot(*side)) * dear
                np.minimum(self.far, self._shifted(side) + step, out=self.far)

    def ahead(self, here: Array) -> Array:
        """A point some cells further on the way."""
        at = self._cell(here)
        for _ in range(AHEAD):
            near = [(at[0] + dx, at[1] + dy) for dx, dy in SIDES]
            inside = [cell for cell in near if min(cell) >= 0 and max(cell) < self.count]
            at = min([at, *inside], key=lambda cell: float(self.far[cell]))
        return self.low + self.cell * (np.array(at) + 0.5)

    def _cell(self, point: Array) -> tuple[int, int]:
        x, y = np.clip(((point - self.low) / self.cell).astype(int), 0, self.count - 1)
        return int(x), int(y)

    def _shifted(self, side: tuple[int, int]) -> Array:
        """Of each cell the neighbour's distance on that side."""
        edged = np.pad(self.far, 1, constant_values=np.inf)
        x, y = 1 + side[0], 1 + side[1]
        return edged[x : x + self.count, y : y + self.count]

"""Map where the filter intervened: a bounded grid from above, over all episodes."""

from __future__ import annotations

from collections.abc import Sequence

from brakeline.logs.episode_stats import Figures, kind_of
from brakeline.messaging import brakeline_pb2 as pb

FIRST_CELL = 0.1  # m
MOST_CELLS = 6400

COLUMNS = {int(pb.ADJUSTED): 1, int(pb.FAILSAFE): 2}  # of the counts of a cell


class InterventionMap:
    """Counts of steps by grid cell. When there are too many cells, their width doubles."""

    def __init__(self) -> None:
        self.cell = FIRST_CELL
        self.cells: dict[tuple[int, int], list[int]] = {}  # steps, adjusted, failsafes, collisions

    def step(self, state: Sequence[float], step: pb.Step) -> None:
        """Add a step.

        Args:
            state: `step.state`, which the caller has read already; x and y [m] come first.
        """
        cell = self.cell
        place = int(state[0] // cell), int(state[1] // cell)
        counts = self.cells.get(place)
        if counts is None:
            counts = self.cells[place] = [0, 0, 0, 0]
            if len(self.cells) > MOST_CELLS:
                self._coarsen()
                counts = self.cells[place[0] // 2, place[1] // 2]
        counts[0] += 1
        if (column := COLUMNS.get(kind_of(step))) is not None:
            counts[column] += 1
        if step.collision:
            counts[3] += 1

    def _coarsen(self) -> None:
        self.cell *= 2.0
        coarse: dict[tuple[int, int], list[int]] = {}
        for (x, y), counts in self.cells.items():
            sums = coarse.setdefault((x // 2, y // 2), [0, 0, 0, 0])
            for i, count in enumerate(counts):
                sums[i] += count
        self.cells = coarse

    def figures(self) -> Figures:
        """Return `cells`: [x, y of the lower left corner in cells, steps, adjusted, failsafes, collisions]."""
        return {"cell": self.cell, "cells": [[x, y, *counts] for (x, y), counts in sorted(self.cells.items())]}

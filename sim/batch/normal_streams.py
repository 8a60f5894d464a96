"""The noise of many robots, each from its own random generator."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from brakeline.messaging.obstacle import Array
from brakeline.sim.ground_estimator import CUT

Rows = NDArray[np.intp]

DRAWN = 1024  # numbers that a generator draws at once


class NormalStreams:
    """The normal numbers of N generators. A row gets the numbers that `cut_normal` would draw from its generator."""

    def __init__(self, count: int, ahead: bool = True) -> None:
        """ahead: draw many numbers at once. Give False if other code draws from the generators, too."""
        self._generators: list[np.random.Generator | None] = [None] * count
        self._ahead = ahead
        self._drawn = np.empty((count, DRAWN))
        self._next = np.full(count, DRAWN)

    def begin(self, row: int, generator: np.random.Generator) -> None:
        """Use this generator from now on."""
        self._generators[row] = generator
        self._next[row] = DRAWN

    def normal(self, rows: Rows, size: int) -> Array:
        """Draw numbers (rows, size) with a standard deviation of 1."""
        return self._take(rows, np.ones((len(rows), size), dtype=bool))

    def cut_normal(self, rows: Rows, sigma: float, size: int) -> Array:
        """Draw numbers (rows, size) with a standard deviation `sigma`, cut off as `cut_normal` does."""
        every = np.ones((len(rows), size), dtype=bool)
        draw = self._take(rows, every)
        while (beyond := np.abs(draw) > CUT).any():
            some = beyond.any(axis=1)
            draw[beyond] = self._take(rows[some], beyond[some])[beyond[some]]
        return np.asarray(sigma * draw)

    def _take(self, rows: Rows, wanted: NDArray[np.bool_]) -> Array:
        """Return the next numbers of each row, in the places (rows, size) that are wanted."""
        needed = wanted.sum(axis=1)
        short = self._next[rows] + needed > DRAWN
        for row, count in zip(rows[short].tolist(), needed[short].tolist(), strict=True):
            self._refill(row, count)
        places = self._next[rows, None] + np.cumsum(wanted, axis=1) - 1
        self._next[rows] += needed
        return np.asarray(self._drawn[rows[:, None], np.maximum(places, 0)])

    def _refill(self, row: int, needed: int) -> None:
        """Move the unused numbers of a row to the front, and draw others after them: so that `needed` are there."""
        generator = self._generators[row]
        assert generator is not None, "no episode has begun"
        unused = DRAWN - self._next[row]
        count = (DRAWN if self._ahead else needed) - unused
        if unused:
            self._drawn[row, DRAWN - count - unused : DRAWN - count] = self._drawn[row, self._next[row] :]
        self._drawn[row, DRAWN - count :] = generator.standard_normal(count)
        self._next[row] = DRAWN - count - unused

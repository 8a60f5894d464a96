"""Wind: a mean and gusts about it."""

from __future__ import annotations

import math

import numpy as np

from brakeline.sim.sim_conditions import Wind as Wind

GUST_CUT = 3.0  # sigma at which a gust is cut off


class WindProcess:
    """The wind's course: `velocity` (x, y, z) now, m/s."""

    CHUNK = 256  # draws at once: one number alone costs as much as many

    def __init__(self, wind: Wind, rng: np.random.Generator, timestep: float) -> None:
        """timestep: s between two calls of `advance`."""
        self._wind, self._rng = wind, rng
        direction = float(rng.uniform(-math.pi, math.pi)) if wind.direction is None else wind.direction
        self.mean = (wind.speed * math.cos(direction), wind.speed * math.sin(direction), 0.0)
        self._keep = math.exp(-timestep / wind.correlation)
        self._add = wind.gust * math.sqrt(1.0 - self._keep**2)
        start = rng.standard_normal(3) * wind.gust
        self._gust: list[float] = start.tolist()
        self._draws: list[list[float]] = []
        self.velocity = self.mean
        self.advance()

    def advance(self) -> None:
        """One timestep on."""
        if not self._draws:
            self._draws = self._rng.standard_normal((self.CHUNK, 3)).tolist()
        limit = GUST_CUT * self._wind.gust
        gust, draw = self._gust, self._draws.pop()
        for i in range(3):
            gust[i] = min(max(self._keep * gust[i] + self._add * draw[i], -limit), limit)
        mean = self.mean
        self.velocity = (mean[0] + gust[0], mean[1] + gust[1], mean[2] + gust[2])

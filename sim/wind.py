"""Simulate the wind: a mean velocity and gusts around it."""

from __future__ import annotations

import math

import numpy as np

from brakeline.sim.sim_conditions import Wind as Wind

GUST_LIMIT = 3.0  # standard deviations at which a gust is cut off
DRAWS_AT_ONCE = 256  # one draw alone takes as long as many


class WindProcess:
    """The velocity of the wind over time, a first-order Gauss-Markov process around its mean."""

    def __init__(self, wind: Wind, rng: np.random.Generator, timestep: float) -> None:
        """Draw the mean wind and the first gust. timestep: time between two calls of `advance` [s]."""
        self._wind, self._rng = wind, rng
        direction = float(rng.uniform(-math.pi, math.pi)) if wind.direction is None else wind.direction
        # (x, y, z) mean velocity, m/s
        self.mean = (wind.speed * math.cos(direction), wind.speed * math.sin(direction), 0.0)
        self._decay = math.exp(-timestep / wind.correlation)
        self._innovation = wind.gust * math.sqrt(1.0 - self._decay**2)
        start = rng.standard_normal(3) * wind.gust
        self._gust: list[float] = start.tolist()
        self._draws: list[list[float]] = []
        self.velocity = self.mean  # (x, y, z) present velocity, m/s
        self.advance()

    def advance(self) -> None:
        """Move on by one time step."""
        if not self._draws:
            self._draws = self._rng.standard_normal((DRAWS_AT_ONCE, 3)).tolist()
        limit = GUST_LIMIT * self._wind.gust
        gust, draw = self._gust, self._draws.pop()
        for i in range(3):
            gust[i] = min(max(self._decay * gust[i] + self._innovation * draw[i], -limit), limit)
        mean = self.mean
        self.velocity = (mean[0] + gust[0], mean[1] + gust[1], mean[2] + gust[2])

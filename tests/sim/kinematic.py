"""A quadrotor without physics: a point whose velocity lags behind its setpoint."""

import math

import numpy as np

from brakeline.sim.arena import Arena
from brakeline.sim.vehicle import Period
from tests.robots import QUADROTOR

SAMPLES = 10
LAG = 0.2  # s
BODY = 0.28  # m, distance of a collision


class PointMass:
    """A point mass with the interface `brakeline.sim.vehicle.Vehicle`."""

    def __init__(self, arena: Arena, rng: np.random.Generator) -> None:
        self.arena, self._rng = arena, rng
        self.true = np.array([*arena.start, *np.zeros(6)])
        self.input = np.zeros(3)
        self.measured = self._measure()
        self.scale = 1.0

    def _measure(self) -> np.ndarray:
        bound = np.asarray(QUADROTOR.measurement_bound)
        return self.true + self._rng.uniform(-bound, bound)

    def step(self, input: np.ndarray) -> Period:
        slew = np.asarray(QUADROTOR.action_slew)
        self.input = np.clip(np.clip(input, QUADROTOR.low(), QUADROTOR.high()), self.input - slew, self.input + slew)
        start, path = self.measured[:3], np.empty((SAMPLES, 3))
        position, velocity = self.true[:3], self.true[3:6]
        decay = math.exp(-QUADROTOR.period / SAMPLES / LAG)
        for i in range(SAMPLES):
            velocity = self.scale * self.input + decay * (velocity - self.scale * self.input)
            position = path[i] = position + velocity * (QUADROTOR.period / SAMPLES)
        self.true = np.concatenate((position, velocity, (self.input - velocity) / LAG))
        self.measured = self._measure()
        surfaces = self.arena.shapes.distance(path).min(axis=0)
        closest, clearance = surfaces.min() - QUADROTOR.footprint, surfaces[-1] - QUADROTOR.footprint
        return Period(self.measured, self.true, bool(surfaces.min() < BODY), closest, clearance, path - start, 0.0)

    def initial_period(self) -> Period:
        clearance = float(self.arena.shapes.distance(self.true[:3]).min()) - QUADROTOR.footprint
        return Period(self.measured, self.true, False, clearance, clearance, np.zeros((SAMPLES, 3)), 0.0)

    def alter(self, **changes: float) -> None:
        self.scale = changes["scale"]

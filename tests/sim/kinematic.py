"""A quadrotor without physics: a point whose velocity lags behind its setpoint."""

import math
from collections.abc import Callable
from functools import partial

import numpy as np

from brakeline.sim.arena import Arena
from brakeline.sim.vehicle import Period, SimulatedVehicle
from tests.robots import QUADROTOR

LAG = 0.2  # s
BODY = 0.28  # m, distance of a collision


class PointMass(SimulatedVehicle):
    """A point mass. `alter(scale=...)` multiplies its setpoints."""

    robot, samples = QUADROTOR, 10
    scale = 1.0

    def __init__(self, arena: Arena, rng: np.random.Generator) -> None:
        self.arena, self._rng = arena, rng
        self.true = np.array([*arena.start, *np.zeros(6)])
        self.input = np.zeros(3)
        self.measured = self._measure()

    def _measure(self) -> np.ndarray:
        bound = np.asarray(QUADROTOR.measurement_bound)
        return self.true + self._rng.uniform(-bound, bound)

    def step(self, input: np.ndarray) -> Period:
        self.input = QUADROTOR.clip_input(input, self.input)
        start, path = self.measured[:3], np.empty((self.samples, 3))
        position, velocity = self.true[:3], self.true[3:6]
        time = QUADROTOR.period / self.samples
        for i in range(self.samples):
            velocity = self.scale * self.input + math.exp(-time / LAG) * (velocity - self.scale * self.input)
            position = path[i] = position + velocity * time
        self.true = np.concatenate((position, velocity, (self.input - velocity) / LAG))
        self.measured = self._measure()
        collided = bool(self.clearance(path).min() < BODY - QUADROTOR.footprint)
        return self._report(collided, path, path - start, 0.0)

    def setters(self) -> dict[str, Callable[[float], None]]:
        return {"scale": partial(setattr, self, "scale")}

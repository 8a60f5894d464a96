"""A kinematic robot for the tests of the filter: exact and fast, without a physics engine."""

from __future__ import annotations

import itertools

import numpy as np

from brakeline.deploy.data.excitation import excitation
from brakeline.safety.model.dataset import Dataset, Trajectory
from tests.robots import GROUND

SUBSTEPS = 10
LAG = 0.05  # s
FIX = 0.004  # m and rad, bound of the measurement noise


class Unicycle:
    """Speeds follow the input with a lag; the pose is integrated in substeps."""

    def __init__(self, pose, rng, noise=1.0, slip=0.0):
        self.rng, self.noise, self.slip = rng, noise, slip
        self.state = np.concatenate([np.asarray(pose, float), np.zeros(2)])

    def measure(self):
        bound = self.noise * np.array([FIX, FIX, FIX, 0.002, 0.004])
        return self.state + self.rng.uniform(-bound, bound)

    def step(self, u):
        """Drive for one period; return the positions (S, 2) in the frame of the start, and the change of heading."""
        dt = GROUND.period / SUBSTEPS
        start, path = self.state.copy(), np.zeros((SUBSTEPS, 2))
        x, y, heading, v, w = self.state
        for i in range(SUBSTEPS):
            v += (u[0] * (1.0 + self.slip) - v) * (1.0 - np.exp(-dt / LAG))
            w += (u[1] - w) * (1.0 - np.exp(-dt / LAG))
            x, y, heading = x + v * dt * np.cos(heading), y + v * dt * np.sin(heading), heading + w * dt
            cos, sin = np.cos(start[2]), np.sin(start[2])
            dx, dy = x - start[0], y - start[1]
            path[i] = cos * dx + sin * dy, -sin * dx + cos * dy
        self.state = np.array([x, y, heading, v, w])
        return path, heading - start[2]

    def trajectory(self, inputs) -> Trajectory:
        states, done, paths, turned = [self.measure()], [], [], []
        for u in inputs:
            path, turn = self.step(u)
            states.append(self.measure())
            done.append(u)
            paths.append(path)
            turned.append(turn)
        return Trajectory(*(np.array(part) for part in (states, done, paths, turned)))


def record(trajectories=40, periods=300, seed=0, **options) -> Dataset:
    """Return a data set of this robot, excited as `brakeline collect` excites a real one."""
    parts = []
    for i in range(trajectories):
        rng = np.random.default_rng((seed, i))
        robot = Unicycle((0.0, 0.0, rng.uniform(-3, 3)), rng, **options)
        parts.append(robot.trajectory(itertools.islice(excitation(GROUND, rng), periods)))
    return Dataset(GROUND, tuple(parts), {"origin": "unicycle"})

"""The observations of many ground robots: `GroundObservation` for each row of arrays."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from brakeline.messaging.obstacle import Array
from brakeline.messaging.task import RobotWithTask
from brakeline.sim.batch.normal_streams import NormalStreams
from brakeline.sim.batch.obstacle_batch import ObstacleBatch
from brakeline.sim.observations import GOAL_DISTANCE_SCALE, GroundObservation

Rows = NDArray[np.intp]


class GroundObservationBatch:
    """The observations of N robots; see `GroundObservation` for their coordinates."""

    def __init__(
        self, size: int, robot: RobotWithTask, obstacles: ObstacleBatch, streams: NormalStreams, noise: float
    ) -> None:
        """noise: standard deviation of a range [m], drawn from the streams."""
        self._rays, self._largest, self._period = robot.task.rays, robot.high(), robot.period
        self._obstacles, self._streams, self._noise = obstacles, streams, noise
        self._memory = np.zeros(size)  # rad/s, of the turn rate

    def begin(self, rows: Rows) -> None:
        """Begin episodes."""
        self._memory[rows] = 0.0

    def observe(self, rows: Rows, true: Array, measured: Array, inputs: Array, goals: Array) -> Array:
        """Return the observations (rows, o) after a period, not yet clipped.

        Args:
            true (rows, 5), measured (rows, 5), inputs (rows, 2), goals (rows, 2) [m]: see `ObservationModel.observe`.
        """
        share = 1.0 - math.exp(-self._period / GroundObservation.MEMORY_TIME)
        self._memory[rows] += share * (measured[:, 4] - self._memory[rows])
        away = goals - measured[:, :2]
        bearing = np.arctan2(away[:, 1], away[:, 0]) - measured[:, 2]
        own = (
            np.hypot(away[:, 0], away[:, 1]) / GOAL_DISTANCE_SCALE,
            np.sin(bearing),
            np.cos(bearing),
            measured[:, 3] / self._largest[0],
            measured[:, 4] / self._largest[1],
            *(inputs / self._largest).T,
            self._memory[rows] / self._largest[1],
        )
        return np.column_stack([self._ranges(rows, true) / self._rays.range, *own])

    def _ranges(self, rows: Rows, true: Array) -> Array:
        """Return the ranges (rows, R) [m], with noise unless a beam hits nothing."""
        far, (x, y) = self._rays.range, self._rays.directions.T
        cos, sin = np.cos(true[:, 2]), np.sin(true[:, 2])
        origins = true[:, :2] + GroundObservation.LIDAR_X * np.stack((cos, sin), axis=1)
        cos, sin = cos[:, None], sin[:, None]
        beams = np.stack((cos * x - sin * y, sin * x + cos * y), axis=2)
        ranges = self._obstacles.cast(rows, origins, beams, far)
        noisy = ranges + self._streams.cut_normal(rows, self._noise, ranges.shape[1])
        return np.where(ranges < far, np.clip(noisy, 0.0, far), far)

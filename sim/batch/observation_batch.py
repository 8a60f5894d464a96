"""The observations of many robots: `GroundObservation` and `QuadrotorObservation` for each row of arrays."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod

import numpy as np

from brakeline.messaging.obstacle import Array
from brakeline.messaging.task import RobotWithTask
from brakeline.sim.batch.normal_streams import NormalStreams, Rows
from brakeline.sim.batch.obstacle_batch import ObstacleBatch
from brakeline.sim.observations import GOAL_DISTANCE_SCALE, GroundObservation, QuadrotorObservation


class ObservationBatch(ABC):
    """The observations of N robots; see `ObservationModel`."""

    def __init__(
        self, size: int, robot: RobotWithTask, obstacles: ObstacleBatch, streams: NormalStreams, noise: float
    ) -> None:
        """noise: standard deviation of a range [m], drawn from the streams."""
        self._rays, self._largest, self._period = robot.task.rays, robot.high(), robot.period
        self._obstacles, self._streams, self._noise = obstacles, streams, noise

    def begin(self, rows: Rows) -> None:  # noqa: B027, most have no memory
        """Begin episodes."""

    @abstractmethod
    def observe(self, rows: Rows, true: Array, measured: Array, inputs: Array, goals: Array) -> Array:
        """Return the observations (rows, o) after a period, not yet clipped.

        Args:
            true (rows, n), measured (rows, n), inputs (rows, m), goals (rows, d) [m]: see `ObservationModel.observe`.
        """

    @abstractmethod
    def speeds(self, states: Array) -> Array:
        """Return the speeds (rows,) [m/s] in states (rows, n)."""

    def _shares(self, rows: Rows, origins: Array, beams: Array) -> Array:
        """Return the ranges (rows, R) of beams, as shares of the largest; beams that hit nothing have no noise."""
        far = self._rays.range
        ranges = self._obstacles.cast(rows, origins, beams, far)
        noisy = ranges + self._streams.cut_normal(rows, self._noise, ranges.shape[1])
        return np.asarray(np.where(ranges < far, np.clip(noisy, 0.0, far), far) / far)


class GroundObservationBatch(ObservationBatch):
    """See `GroundObservation` for the coordinates."""

    def __init__(
        self, size: int, robot: RobotWithTask, obstacles: ObstacleBatch, streams: NormalStreams, noise: float
    ) -> None:
        super().__init__(size, robot, obstacles, streams, noise)
        self._memory = np.zeros(size)  # rad/s, of the turn rate

    def begin(self, rows: Rows) -> None:
        self._memory[rows] = 0.0

    def observe(self, rows: Rows, true: Array, measured: Array, inputs: Array, goals: Array) -> Array:
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
        x, y = self._rays.directions.T
        cos, sin = np.cos(true[:, 2]), np.sin(true[:, 2])
        origins = true[:, :2] + GroundObservation.LIDAR_X * np.stack((cos, sin), axis=1)
        cos, sin = cos[:, None], sin[:, None]
        beams = np.stack((cos * x - sin * y, sin * x + cos * y), axis=2)
        return np.column_stack([self._shares(rows, origins, beams), *own])

    def speeds(self, states: Array) -> Array:
        return np.asarray(states[:, 3])


class QuadrotorObservationBatch(ObservationBatch):
    """See `QuadrotorObservation` for the coordinates."""

    def observe(self, rows: Rows, true: Array, measured: Array, inputs: Array, goals: Array) -> Array:
        offset = goals - measured[:, :3]
        distance = np.sqrt((offset * offset).sum(axis=1, keepdims=True))
        beams = np.tile(self._rays.directions, (len(rows), 1, 1))
        return np.column_stack(
            [
                self._shares(rows, true[:, :3], beams),
                offset / (distance + QuadrotorObservation.GOAL_SCALE),
                measured[:, 3:6] / self._largest,
                inputs / self._largest,
            ]
        )

    def speeds(self, states: Array) -> Array:
        return np.asarray(np.sqrt((states[:, 3:6] ** 2).sum(axis=1)))

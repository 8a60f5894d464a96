"""State estimation of many ground robots: `GroundEstimator` for each row of arrays, with the same errors."""

from __future__ import annotations

import math

import numpy as np

from brakeline.messaging.obstacle import Array
from brakeline.sim.batch.normal_streams import NormalStreams, Rows
from brakeline.sim.ground_estimator import GroundEstimator, steady_gain, wrap
from brakeline.sim.sim_conditions import NoiseLevels


class GroundEstimatorBatch:
    """The estimates of N robots. Every argument and result has a row for each of the `rows` that it is about."""

    def __init__(
        self, size: int, noise: NoiseLevels, streams: NormalStreams, radius: float, sample_time: float
    ) -> None:
        """streams: the errors. radius: of a wheel [m]. sample_time: between two samples of encoders and gyro [s]."""
        self._noise, self._streams, self._radius, self._sample_time = noise, streams, radius, sample_time
        self.pose = np.zeros((size, 3))  # (N, 3) estimated x, y [m] and heading [rad]
        self._scale, self._bias, self._ticks = np.ones((size, 2)), np.zeros(size), np.zeros((size, 2))
        self._tick = 2.0 * math.pi / noise.encoder_ticks
        gain = steady_gain(noise.drift_position, noise.fix_position)
        self._gain = np.array([gain, gain, steady_gain(noise.drift_heading, noise.fix_heading)])
        self._fix_sigma = np.array([noise.fix_position, noise.fix_position, noise.fix_heading])

    def begin(self, rows: Rows, pose: Array, wheels: Array) -> None:
        """Start from a first fix: true poses (rows, 3) and wheel angles (rows, 2)."""
        noise, draw = self._noise, self._streams.cut_normal
        self._scale[rows] = 1.0 + draw(rows, noise.scale * noise.wheel_scale, 2)
        self._bias[rows] = draw(rows, noise.scale * noise.gyro_bias, 1)[:, 0]
        self._ticks[rows] = np.floor(wheels / self._tick)
        self.pose[rows] = self._fix(rows, pose)

    def update(self, rows: Rows, wheels: Array, turn_rates: Array, pose: Array) -> tuple[Array, Array, Array]:
        """Update the estimates with the samples of one period; see `GroundEstimator.update`.

        Args:
            wheels (rows, S, 2), turn_rates (rows, S), pose (rows, 3): true values.

        Returns:
            The measured states (rows, 5), the paths (rows, S, 2) and the angles turned (rows,).
        """
        noise, recent = self._noise, GroundEstimator.RECENT
        distances = self._wheel_distances(rows, wheels)
        gyro = self._streams.cut_normal(rows, noise.scale * noise.gyro, turn_rates.shape[1])
        rates = turn_rates + self._bias[rows, None] + gyro
        turns = rates * self._sample_time
        ends = np.cumsum(turns, axis=1)
        middle = ends - 0.5 * turns
        path = np.cumsum(distances[..., None] * np.stack((np.cos(middle), np.sin(middle)), axis=2), axis=1)
        self._correct(rows, path[:, -1], ends[:, -1], pose)
        speed = distances[:, -recent:].mean(axis=1) / self._sample_time
        measured = np.column_stack([self.pose[rows], speed, rates[:, -recent:].mean(axis=1)])
        return measured, path, ends[:, -1]

    def _wheel_distances(self, rows: Rows, wheels: Array) -> Array:
        """Return the distance (rows, S) of the axle's middle from sample to sample, by the encoders [m]."""
        ticks = np.floor(wheels / self._tick)
        turns = np.diff(ticks, axis=1, prepend=self._ticks[rows, None]) * self._tick
        self._ticks[rows] = ticks[:, -1]
        count = turns.shape[1] * turns.shape[2]
        slip = self._streams.cut_normal(rows, self._noise.scale * self._noise.wheel_slip, count).reshape(turns.shape)
        return np.asarray((turns * self._scale[rows, None] * (1.0 + slip)).mean(axis=2) * self._radius)

    def _correct(self, rows: Rows, moved: Array, turned: Array, pose: Array) -> None:
        """Move the poses by (rows, 2) metres in the old body frames and by angles, then towards fixes."""
        x, y, heading = self.pose[rows].T
        cos, sin = np.cos(heading), np.sin(heading)
        ahead, aside = moved.T
        prediction = np.column_stack([x + cos * ahead - sin * aside, y + sin * ahead + cos * aside, heading + turned])
        error = self._fix(rows, pose) - prediction
        error[:, 2] = wrap(error[:, 2])
        estimate = prediction + self._gain * error
        estimate[:, 2] = wrap(estimate[:, 2])
        self.pose[rows] = estimate

    def _fix(self, rows: Rows, pose: Array) -> Array:
        """Return fixes (rows, 3) of true poses (rows, 3)."""
        fix = pose + self._streams.cut_normal(rows, self._noise.scale, 3) * self._fix_sigma
        fix[:, 2] = wrap(fix[:, 2])
        return np.asarray(fix)

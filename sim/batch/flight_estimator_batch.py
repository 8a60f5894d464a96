"""State estimation of many quadrotors behind MAVLink: `FlightEstimator`, and the state in the autopilot's messages."""

from __future__ import annotations

import numpy as np

from brakeline.messaging.obstacle import Array
from brakeline.sim.autopilot.ned_frames import attitude
from brakeline.sim.batch.normal_streams import NormalStreams, Rows
from brakeline.sim.flight_estimator import QuadrotorNoise
from brakeline.sim.kernels.flight_kernels import GRAVITY

CONJUGATE, FORWARD_RIGHT_DOWN = np.array([1.0, -1.0, -1.0, -1.0]), np.array([1.0, -1.0, -1.0])


class FlightEstimatorBatch:
    """The estimates of N quadrotors. Every argument and result has a row for each of the `rows` that it is about."""

    def __init__(self, size: int, noise: QuadrotorNoise, streams: NormalStreams) -> None:
        """streams: the source of all errors."""
        self._noise, self._streams = noise, streams
        self._sigma = noise.scale * np.repeat((noise.position, noise.velocity, noise.attitude), 3)
        # errors: (N, 9) of position [m], velocity [m/s] and attitude [rad] at the start of the period
        self.errors, self._next = np.zeros((size, 9)), np.zeros((size, 9))

    def begin(self, rows: Rows) -> None:
        """Draw the first errors."""
        self._next[rows] = self._draw(rows)

    def begin_period(self, rows: Rows) -> None:
        """Draw the errors that grow, or shrink, in the next period."""
        self.errors[rows], self._next[rows] = self._next[rows], self._draw(rows)

    def steps(self, rows: Rows, count: int) -> Array:
        """Return the errors (rows, count, 9) after each of `count` equal parts of the period."""
        shares, start = np.linspace(0.0, 1.0, count + 1)[1:, None], self.errors[rows, None]
        return np.asarray(start + shares * (self._next[rows, None] - start))

    def path(self, rows: Rows, positions: Array) -> Array:
        """Return positions (rows, S, 3) [m], at even times of the period, as messages report them."""
        return _sent(positions + self.steps(rows, positions.shape[1])[..., :3])

    def read(self, rows: Rows, coordinates: Array, accelerations: Array) -> Array:
        """Return the states (rows, 9) that messages report at the end of the period.

        Args:
            coordinates (rows, 13 or more): true, as of `flight_kernels`.
            accelerations (rows, 3): true, in the world [m/s²].
        """
        errors, white = self._next[rows], self._streams.cut_normal(rows, self._noise.scale, 6)
        attitude = coordinates[:, 3:7]
        force = _rotated(attitude * CONJUGATE, accelerations + np.array([0.0, 0.0, GRAVITY]))
        force += self._noise.accelerometer * white[:, 3:]
        force = _rotated(_sent(_to_ned(_tilted(attitude, errors[:, 6:]))), _sent(force * FORWARD_RIGHT_DOWN))
        motion = _sent(np.column_stack([coordinates[:, :3], coordinates[:, 7:10]]) + errors[:, :6])
        return np.column_stack([motion, force[:, 1], force[:, 0], -force[:, 2] - GRAVITY])

    def _draw(self, rows: Rows) -> Array:
        return self._streams.cut_normal(rows, 1.0, 9) * self._sigma


def _sent(numbers: Array) -> Array:
    """Return numbers as MAVLink's messages carry them, in single precision."""
    return np.asarray(numbers.astype(np.float32), dtype=np.float64)


def _rotated(q: Array, vectors: Array) -> Array:
    """Rotate vectors (rows, 3) by quaternions (rows, 4): `rotate` for arrays."""
    twice = 2.0 * np.cross(q[:, 1:], vectors)
    return np.asarray(vectors + q[:, :1] * twice + np.cross(q[:, 1:], twice))


def _tilted(q: Array, angles: Array) -> Array:
    """Turn attitudes (rows, 4) by small angles (rows, 3) [rad] about the body's axes: `tilted` for arrays."""
    w, v, half = q[:, :1], q[:, 1:], 0.5 * angles
    turned = np.column_stack([w - (v * half).sum(axis=1, keepdims=True), v + w * half + np.cross(v, half)])
    return np.asarray(turned / np.sqrt(1.0 + (half * half).sum(axis=1, keepdims=True)))


def _to_ned(q: Array) -> Array:
    """Convert attitudes (rows, 4) from (ENU, forward-left-up) to (NED, forward-right-down)."""
    w, x, y, z = q.T
    return np.column_stack(attitude((w, x, y, z)))

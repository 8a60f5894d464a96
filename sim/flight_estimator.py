"""State estimation of the quadrotor: position, velocity, attitude and IMU, each with errors."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from brakeline.messaging.obstacle import Array
from brakeline.sim.ground_estimator import cut_normal
from brakeline.sim.kernels.flight_kernels import GRAVITY
from brakeline.sim.sim_conditions import QuadrotorNoise as QuadrotorNoise

Vector = tuple[float, float, float]
Quaternion = tuple[float, float, float, float]  # w, x, y, z; world from body


@dataclass(frozen=True)
class Estimate:
    """One estimate: ENU, SI units; body axes x forward, y left, z up."""

    position: Vector  # m
    velocity: Vector  # m/s
    attitude: Quaternion
    rates: Vector  # rad/s, about the body's axes
    specific_force: Vector  # m/s² along the body's axes, as an accelerometer measures it

    @property
    def acceleration(self) -> Vector:
        """Acceleration in the world, without gravity [m/s²]."""
        x, y, z = rotate(self.attitude, self.specific_force)
        return (x, y, z - GRAVITY)


class FlightEstimator:
    """Adds errors that change slowly, as those of a Kalman filter: drawn once a period and interpolated linearly.

    Interpolated errors never exceed the cut-off, and errors of different periods are independent.
    """

    def __init__(self, noise: QuadrotorNoise, rng: np.random.Generator, steps: int) -> None:
        """Draw the first errors. steps: number of calls of `advance` in a period."""
        self.noise, self._rng, self._steps = noise, rng, steps
        self._sigma = noise.scale * np.repeat((noise.position, noise.velocity, noise.attitude), 3)
        # errors: (9,) of position [m], velocity [m/s] and attitude [rad]
        self.errors = self._next = self._draw()
        self._slopes = np.zeros(9)
        self._left = 0

    def advance(self) -> None:
        if self._left == 0:
            self.errors, self._next = self._next, self._draw()
            self._slopes = (self._next - self.errors) / self._steps
            self._left = self._steps
        self._left -= 1
        if self._left == 0:
            self.errors = self._next
        else:
            self.errors = self.errors + self._slopes

    def read(
        self, position: Vector, velocity: Vector, attitude: Quaternion, rates: Vector, acceleration: Vector
    ) -> Estimate:
        """Return the estimate of a true state; `acceleration` is in the world frame [m/s²]."""
        e = self.errors.tolist()
        white = cut_normal(self._rng, self.noise.scale, (6,)).tolist()
        ax, ay, az = acceleration
        w, x, y, z = attitude
        specific_force = rotate((w, -x, -y, -z), (ax, ay, az + GRAVITY))
        force, gyro = self.noise.accelerometer, self.noise.gyro
        return Estimate(
            (position[0] + e[0], position[1] + e[1], position[2] + e[2]),
            (velocity[0] + e[3], velocity[1] + e[4], velocity[2] + e[5]),
            tilted(attitude, (e[6], e[7], e[8])),
            (rates[0] + gyro * white[0], rates[1] + gyro * white[1], rates[2] + gyro * white[2]),
            (
                specific_force[0] + force * white[3],
                specific_force[1] + force * white[4],
                specific_force[2] + force * white[5],
            ),
        )

    def _draw(self) -> Array:
        return cut_normal(self._rng, 1.0, (9,)) * self._sigma


def rotate(attitude: Quaternion, vector: Vector) -> Vector:
    """Rotate a vector from the body's axes to the world."""
    w, x, y, z = attitude
    a, b, c = vector
    tx, ty, tz = 2.0 * (y * c - z * b), 2.0 * (z * a - x * c), 2.0 * (x * b - y * a)
    return (a + w * tx + y * tz - z * ty, b + w * ty + z * tx - x * tz, c + w * tz + x * ty - y * tx)


def tilted(attitude: Quaternion, angles: Vector) -> Quaternion:
    """Return the attitude turned by small angles about the body's axes [rad]."""
    w, x, y, z = attitude
    a, b, c = 0.5 * angles[0], 0.5 * angles[1], 0.5 * angles[2]
    q = (w - x * a - y * b - z * c, x + w * a + y * c - z * b, y + w * b + z * a - x * c, z + w * c + x * b - y * a)
    size = (1.0 + a * a + b * b + c * c) ** 0.5
    return (q[0] / size, q[1] / size, q[2] / size, q[3] / size)

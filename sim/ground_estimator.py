"""State estimation of the ground robot: wheel encoders, gyro and a map-based pose fix, each with errors, fused."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TypeVar

import numpy as np

from brakeline.messaging.obstacle import Array
from brakeline.sim.sim_conditions import NoiseLevels as NoiseLevels

Angle = TypeVar("Angle", float, Array)

CUT = 2.0  # standard deviations at which every sensor error is cut off


def cut_normal(rng: np.random.Generator, sigma: float, shape: tuple[int, ...]) -> Array:
    """Draw normal numbers with a standard deviation `sigma`, again until all lie within ±`CUT`·sigma."""
    draw = rng.standard_normal(shape)
    while (beyond := np.abs(draw) > CUT).any():
        draw[beyond] = rng.standard_normal(int(beyond.sum()))
    return np.asarray(sigma * draw)


def wrap(angle: Angle) -> Angle:
    """Return the same angle, or angles, in [-π, π), rad."""
    return (angle + math.pi) % (2.0 * math.pi) - math.pi


def heading_of(quaternion: Sequence[float] | Array) -> float:
    """Return the heading [rad] of an attitude (w, x, y, z): the angle of its x axis about the vertical."""
    w, x, y, z = quaternion
    return math.atan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))


def steady_gain(drift: float, fix: float) -> float:
    """Return the steady-state Kalman gain of a random walk (standard deviation `drift` a step) measured with `fix`."""
    ratio = (drift / fix) ** 2
    prior = 0.5 * (ratio + math.sqrt(ratio * ratio + 4.0 * ratio))  # variance before the fix, in units of fix²
    return prior / (prior + 1.0)


@dataclass(frozen=True)
class GroundEstimate:
    """The estimate after one period of sensor samples."""

    measured: Array  # (5,): x, y [m], heading [rad], speed [m/s], turn rate [rad/s], at the end of the period
    path: Array  # (S, 2) m: dead-reckoned position at each sample, in the robot's frame at the start of the period
    turned: float  # rad, dead-reckoned change of heading over the period


class GroundEstimator:
    """Dead reckoning, corrected once a period by a fixed share of its difference to the pose fix.

    The estimates of speed and turn rate are means of the last `RECENT` samples, not of the period.
    """

    RECENT = 2

    def __init__(
        self,
        noise: NoiseLevels,
        rng: np.random.Generator,
        pose: Array,
        wheels: Array,
        wheel_radius: float,
        sample_time: float,
    ) -> None:
        """Start from a first fix.

        Args:
            pose: (3,) true x, y [m] and heading [rad].
            wheels: (2,) true angles, left and right [rad].
            wheel_radius: m.
            sample_time: s between two samples of encoders and gyro.
        """
        self.noise, self._rng = noise, rng
        self._wheel_radius, self._sample_time = wheel_radius, sample_time
        self._scale = 1.0 + cut_normal(rng, noise.scale * noise.wheel_scale, (2,))
        self._bias = float(cut_normal(rng, noise.scale * noise.gyro_bias, ()))
        self._tick = 2.0 * math.pi / noise.encoder_ticks
        self._ticks = self._count(wheels)
        gain = steady_gain(noise.drift_position, noise.fix_position)
        self._gain = np.array([gain, gain, steady_gain(noise.drift_heading, noise.fix_heading)])
        self.pose = self._fix(pose)  # (3,) estimated x, y [m] and heading [rad]

    def update(self, wheels: Array, turn_rates: Array, pose: Array) -> GroundEstimate:
        """Update the estimate with the samples of one period.

        Args:
            wheels: (S, 2) true angles of the wheels at the samples [rad].
            turn_rates: (S,) true mean turn rate between samples [rad/s], as a gyro with an internal filter reports it.
            pose: (3,) true pose at the end of the period.
        """
        distances = self._wheel_distances(wheels)
        gyro_noise = cut_normal(self._rng, self.noise.scale * self.noise.gyro, turn_rates.shape)
        rates = turn_rates + self._bias + gyro_noise
        path, turned = self._dead_reckon(distances, rates)
        self._correct(path[-1], turned, pose)
        recent = slice(-self.RECENT, None)
        speed = distances[recent].mean() / self._sample_time
        return GroundEstimate(np.array([*self.pose, speed, rates[recent].mean()]), path, turned)

    def _count(self, wheels: Array) -> Array:
        """Return the encoder counts of wheel angles (..., 2)."""
        return np.asarray(np.floor(wheels / self._tick))

    def _wheel_distances(self, wheels: Array) -> Array:
        """Return the distance (S,) of the axle's middle from sample to sample, by the encoders [m]."""
        ticks = self._count(wheels)
        turns = np.diff(np.vstack((self._ticks, ticks)), axis=0) * self._tick
        self._ticks = ticks[-1]
        slip = 1.0 + cut_normal(self._rng, self.noise.scale * self.noise.wheel_slip, turns.shape)
        return np.asarray((turns * self._scale * slip).mean(axis=1) * self._wheel_radius)

    def _dead_reckon(self, distances: Array, rates: Array) -> tuple[Array, float]:
        """Sum distances (S,) along the headings halfway through each sample: the path (S, 2) and the angle turned."""
        turns = rates * self._sample_time
        ends = np.cumsum(turns)
        middle = ends - 0.5 * turns
        steps = distances[:, None] * np.stack((np.cos(middle), np.sin(middle)), axis=1)
        return np.cumsum(steps, axis=0), float(ends[-1])

    def _correct(self, moved: Array, turned: float, pose: Array) -> None:
        """Move the pose by (2,) metres in the old body frame and by an angle, then towards a fix of the true pose."""
        prediction = self._moved(moved, turned)
        error = self._fix(pose) - prediction
        error[2] = wrap(error[2])
        self.pose = prediction + self._gain * error
        self.pose[2] = wrap(self.pose[2])

    def _moved(self, moved: Array, turned: float) -> Array:
        """Return the pose (3,) after moving by (2,) metres in the body frame and turning by an angle."""
        x, y, heading = self.pose
        cos, sin = math.cos(heading), math.sin(heading)
        return np.array([x + cos * moved[0] - sin * moved[1], y + sin * moved[0] + cos * moved[1], heading + turned])

    def _fix(self, pose: Array) -> Array:
        """Return a fix (3,) of a true pose (3,)."""
        error = cut_normal(self._rng, self.noise.scale, (3,))
        fix = pose + error * (self.noise.fix_position, self.noise.fix_position, self.noise.fix_heading)
        fix[2] = wrap(fix[2])
        return np.asarray(fix)

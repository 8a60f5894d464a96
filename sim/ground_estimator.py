"""What the ground robot knows of itself: wheel encoders, gyro and a map-based pose fix, each with its errors, fused."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from brakeline.sim.sim_conditions import NoiseLevels as NoiseLevels

Array = NDArray[np.float64]


CUT = 2.0  # sigma


def cut_normal(rng: np.random.Generator, sigma: float, shape: tuple[int, ...]) -> Array:
    """Normal numbers of that sigma, drawn again until all lie within ±CUT sigma."""
    draw = rng.standard_normal(shape)
    while (beyond := np.abs(draw) > CUT).any():
        draw[beyond] = rng.standard_normal(int(beyond.sum()))
    return np.asarray(sigma * draw)


def wrap(angle: float) -> float:
    """The same angle in [-π, π), rad."""
    return (angle + math.pi) % (2.0 * math.pi) - math.pi


def steady_gain(drift: float, fix: float) -> float:
    """Gain of the Kalman filter of a random walk (sigma `drift` a step) seen with error `fix`, after many steps."""
    ratio = (drift / fix) ** 2
    prior = 0.5 * (ratio + math.sqrt(ratio * ratio + 4.0 * ratio))  # variance before the fix, in units of fix²
    return prior / (prior + 1.0)


@dataclass(frozen=True)
class Reading:
    """What one period's sensor samples tell."""

    measured: Array  # (5,): x, y [m], heading [rad], speed [m/s], turn rate [rad/s], at the period's end
    path: Array  # (S, 2) m: dead-reckoned position at each sample, in the robot's frame at the period's start
    turned: float  # rad, dead-reckoned change of heading over the period


class Estimator:
    """Dead reckoning, corrected once a period by a fixed share of its difference to the pose fix.

    Speed and turn rate are those of the last `RECENT` samples: the current ones, not the period's mean.
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

        pose: (3,) true x, y [m] and heading [rad]; wheels: (2,) true angles, left and right, rad; wheel_radius: m;
        sample_time: s from one sample of encoders and gyro to the next.
        """
        self.noise, self._rng = noise, rng
        self._wheel_radius, self._sample_time = wheel_radius, sample_time
        self._scale = 1.0 + cut_normal(rng, noise.scale * noise.wheel_scale, (2,))
        self._bias = float(cut_normal(rng, noise.scale * noise.gyro_bias, ()))
        self._tick = 2.0 * math.pi / noise.encoder_ticks
        self._ticks = self._count(wheels)
        gain = steady_gain(noise.drift_position, noise.fix_position)
        self._gain = np.array([gain, gain, steady_gain(noise.drift_heading, noise.fix_heading)])
        self.pose = self._fix(pose)

    def update(self, wheels: Array, turn_rates: Array, pose: Array) -> Reading:
        """Take in one period.

        wheels: (S, 2) true angles of the wheels at the samples, rad; turn_rates: (S,) true mean turn rate from sample
        to sample, rad/s, as a gyro that filters inside reports it; pose: (3,) true pose at the period's end.
        """
        ways = self._encoder_ways(wheels)
        gyro_noise = cut_normal(self._rng, self.noise.scale * self.noise.gyro, turn_rates.shape)
        rates = turn_rates + self._bias + gyro_noise
        path, turned = self._dead_reckon(ways, rates)
        self._correct(path[-1], turned, pose)
        recent = slice(-self.RECENT, None)
        speed = ways[recent].mean() / self._sample_time
        return Reading(np.array([*self.pose, speed, rates[recent].mean()]), path, turned)

    def _count(self, wheels: Array) -> Array:
        """Encoder counts of wheel angles (..., 2)."""
        return np.asarray(np.floor(wheels / self._tick))

    def _encoder_ways(self, wheels: Array) -> Array:
        """Way of the axle's midpoint from sample to sample by the encoders, m. Shape (S,)."""
        ticks = self._count(wheels)
        turns = np.diff(np.vstack((self._ticks, ticks)), axis=0) * self._tick
        self._ticks = ticks[-1]
        slip = 1.0 + cut_normal(self._rng, self.noise.scale * self.noise.wheel_slip, turns.shape)
        return np.asarray((turns * self._scale * slip).mean(axis=1) * self._wheel_radius)

    def _dead_reckon(self, ways: Array, rates: Array) -> tuple[Array, float]:
        """Sum ways (S,) along the headings halfway through each sample: the path (S, 2) and the angle turned."""
        turns = rates * self._sample_time
        ends = np.cumsum(turns)
        middle = ends - 0.5 * turns
        steps = ways[:, None] * np.stack((np.cos(middle), np.sin(middle)), axis=1)
        return np.cumsum(steps, axis=0), float(ends[-1])

    def _correct(self, moved: Array, turned: float, pose: Array) -> None:
        """Move the pose by (2,) metres in the old body frame and an angle, then towards the fix."""
        guess = self._moved(moved, turned)
        error = self._fix(pose) - guess
        error[2] = wrap(error[2])
        self.pose = guess + self._gain * error
        self.pose[2] = wrap(self.pose[2])

    def _moved(self, moved: Array, turned: float) -> Array:
        """The pose (3,) after that."""
        x, y, heading = self.pose
        cos, sin = math.cos(heading), math.sin(heading)
        return np.array([x + cos * moved[0] - sin * moved[1], y + sin * moved[0] + cos * moved[1], heading + turned])

    def _fix(self, pose: Array) -> Array:
        """A pose fix, (3,)."""
        error = cut_normal(self._rng, self.noise.scale, (3,))
        fix = pose + error * (self.noise.fix_position, self.noise.fix_position, self.noise.fix_heading)
        fix[2] = wrap(fix[2])
        return np.asarray(fix)

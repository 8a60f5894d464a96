"""The ground robot in continuous time, as its ROS nodes see it.

The robot accepts a command at any sample and measures at every sample.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from brakeline.messaging.obstacle import Array
from brakeline.messaging.ray_directions import LidarRays
from brakeline.sim.arena import Arena
from brakeline.sim.ground_estimator import GroundEstimator, NoiseLevels, wrap
from brakeline.sim.ground_robot import SAMPLE_TIME, SAMPLES, WHEEL_RADIUS, GroundRobot
from brakeline.sim.lidar import Lidar
from brakeline.sim.range_sensors import with_faults
from brakeline.sim.sim_conditions import SensorFaults

BEAMS = 360  # of the lidar, in a turn
FLAWLESS = SensorFaults()
TOUCHING = 1e-6  # m, in place of a range of 0, which means that a beam has no information


class RealtimeEstimator(GroundEstimator):
    """`GroundEstimator`, one sample at a time: between two pose fixes it returns its dead reckoning."""

    def __init__(self, noise: NoiseLevels, rng: np.random.Generator, pose: Array, *wheels: Any) -> None:
        super().__init__(noise, rng, pose, *wheels)
        # distance [m] and turn rate [rad/s] of each sample since the last fix, and of each of the last `RECENT` samples
        self._moves: list[tuple[float, float]] = []
        self._recent: list[tuple[float, float]] = []

    def add_sample(self, wheels: Array, turn_rate: float, pose: Array) -> Array:
        """Return the measured state (5,) after one more sample.

        Args:
            wheels: (2,) rad, true angles of the wheels.
            turn_rate: rad/s, true.
            pose: (3,) true pose.
        """
        distance = float(self._wheel_distances(wheels[None])[0])
        noise = self.noise.scale * self.noise.gyro * float(np.clip(self._rng.standard_normal(), -2.0, 2.0))
        rate = turn_rate + self._bias + noise
        self._moves.append((distance, rate))
        self._recent = [*self._recent, (distance, rate)][-self.RECENT :]
        path, turned = self._dead_reckon(*np.array(self._moves).T)
        if len(self._moves) == SAMPLES:
            self._correct(path[-1], turned, pose)
            self._moves = []
            x, y, heading = self.pose
        else:
            x, y, heading = self._moved(path[-1], turned)
        mean_distance, mean_rate = np.mean(self._recent, axis=0)
        return np.array([x, y, wrap(heading), mean_distance / self._sample_time, mean_rate])


class RealtimeGroundRobot(GroundRobot):
    """A ground robot in one arena. An input takes effect at the next sample and lasts until another one comes."""

    def __init__(
        self, arena: Arena, rng: np.random.Generator, noise: NoiseLevels | None = None, **physics: Any
    ) -> None:
        """Place the robot at the start of an arena.

        Args:
            physics: `process_noise`, and what `changes_of` returns, as for `GroundRobot`.
        """
        super().__init__(arena, rng, noise, **physics)
        noise = noise or NoiseLevels()
        pose, wheels = self._true_pose(), self._wheels()
        self.realtime_estimator = RealtimeEstimator(noise, rng, pose, wheels, WHEEL_RADIUS, SAMPLE_TIME)
        # how often the robot began to touch a static obstacle, and whether it touches one now
        self.collisions, self._touches = 0, False
        self.closest = float(self.clearance(self.true[:2]))  # m, least distance to an obstacle so far
        self.distance_driven = 0.0  # m

    def advance(self) -> None:
        """Advance to the next sample, by `SAMPLE_TIME` seconds."""
        before = self._true_pose()
        self._controls, self._forces = self._disturbed(self.input, 1)
        self.begin_sample(0)
        touches = self._physics.advance(at_rest=not self.input.any())
        self.collisions += touches and not self._touches
        self._touches = touches
        pose = self._true_pose()
        self.distance_driven += math.dist(before[:2], pose[:2])
        self.true = self._true_state()
        turn_rate = wrap(pose[2] - before[2]) / SAMPLE_TIME
        self.measured = self.realtime_estimator.add_sample(self._wheels(), turn_rate, pose)
        self.closest = min(self.closest, float(self.clearance(pose[:2])))


class SpinningLidar:
    """A lidar that measures one beam after the other. A turn takes `SAMPLES` samples, so its ranges differ in time.

    A beam that hits nothing reports inf, one that hits something too near reports -inf, and one without information
    reports NaN (REP 117).
    """

    farthest = 3.5  # m, the longest range that it measures
    mount = -0.032  # m, its position on the robot's x axis
    gap = 2.0 * math.pi / BEAMS  # rad between two beams

    def __init__(
        self,
        arena: Arena,
        rng: np.random.Generator,
        noise: float,
        nearest: float = 0.12,
        faults: SensorFaults = FLAWLESS,
    ) -> None:
        """Start the first turn.

        Args:
            noise: standard deviation of a range [m].
            nearest: the shortest range that it measures [m].
            faults: of its beams. Their delays have no effect: a scan is never late.
        """
        self.nearest, self._faults, self._rng = nearest, faults, rng
        self._angles: Array = np.asarray(self.gap * np.arange(BEAMS), float)
        directions = np.stack([np.cos(self._angles), np.sin(self._angles)], axis=1)
        sectors = np.array_split(directions, SAMPLES)
        self._sectors = [Lidar(arena, LidarRays(sector, self.farthest), noise, rng) for sector in sectors]
        self._measured: list[Array] = []

    def measure_sector(self, true: Array) -> Array | None:
        """Measure the next sector from a true state (5,).

        Returns:
            The ranges (beams,) [m] of the turn if this sector completes it, otherwise None.
        """
        heading = float(true[2])
        origin = true[:2] + self.mount * np.array([math.cos(heading), math.sin(heading)])
        self._measured.append(self._sectors[len(self._measured)].ranges(origin, heading))
        if len(self._measured) < len(self._sectors):
            return None
        turn, self._measured = np.concatenate(self._measured), []
        limits = self.nearest, self.farthest
        turn = with_faults(np.maximum(turn, TOUCHING), self._angles, limits, self._faults, self._rng)
        reported = np.where(turn >= self.farthest, np.inf, np.where(turn < self.nearest, -np.inf, turn))
        return np.where(turn == 0.0, np.nan, reported)  # only a fault makes a range 0

"""The ground robot in continuous time, as its nodes see it: commands come when they come, sensors tell every sample."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from brakeline.messaging.ray_directions import LidarRays
from brakeline.sim.arena import Arena
from brakeline.sim.ground_estimator import Estimator, NoiseLevels, wrap
from brakeline.sim.ground_robot import GROUND, SAMPLES, WHEEL_RADIUS, GroundRobot
from brakeline.sim.lidar import Lidar
from brakeline.sim.vehicle import clip_input

Array = NDArray[np.float64]

SAMPLE_TIME = GROUND.period / SAMPLES  # s


class RealtimeEstimator(Estimator):
    """The same estimator, asked at every sample: between two pose fixes it tells its dead reckoning."""

    def begin(self) -> None:
        """Before the first sample."""
        self._ways: list[float] = []
        self._rates: list[float] = []  # both since the last fix
        self._recent: list[tuple[float, float]] = []

    def feel(self, wheels: Array, turn_rate: float, pose: Array) -> Array:
        """The measured state (5,) after one more sample: true wheel angles (2,), turn rate [rad/s] and pose (3,)."""
        way = float(self._encoder_ways(wheels[None])[0])
        noise = self.noise.scale * self.noise.gyro * float(np.clip(self._rng.standard_normal(), -2.0, 2.0))
        rate = turn_rate + self._bias + noise
        self._ways.append(way)
        self._rates.append(rate)
        self._recent = [*self._recent, (way, rate)][-self.RECENT :]
        path, turned = self._dead_reckon(np.array(self._ways), np.array(self._rates))
        if len(self._ways) == SAMPLES:
            self._correct(path[-1], turned, pose)
            self._ways, self._rates = [], []
            x, y, heading = self.pose
        else:
            x, y, heading = self._moved(path[-1], turned)
        ways, rates = np.mean(self._recent, axis=0)
        return np.array([x, y, wrap(heading), ways / self._sample_time, rates])


class RealtimeGroundRobot(GroundRobot):
    """A ground robot in one arena. An input counts from the next sample on, and until another one comes.

    collisions: how often it began to touch something; closest: m, the least distance from its disc to an obstacle so
    far; driven: m.
    """

    def __init__(
        self,
        arena: Arena,
        rng: np.random.Generator,
        noise: NoiseLevels | None = None,
        payload_kg: float = 0.0,
        floor_friction: float = 1.0,
    ) -> None:
        super().__init__(arena, rng, noise, payload_kg, floor_friction)
        self.estimator: RealtimeEstimator = RealtimeEstimator(
            noise or NoiseLevels(), rng, self._true_pose(), self._wheels(), WHEEL_RADIUS, SAMPLE_TIME
        )
        self.estimator.begin()
        self.collisions, self._touches = 0, False
        self.closest = float(self._clearance(self.true[:2]))
        self.driven = 0.0

    def drive(self, input: Array) -> None:
        """From now on at (speed [m/s], turn rate [rad/s]), clipped to the robot's bounds.

        Raises:
            BadInput: when the input is not two finite numbers.
        """
        self.input = clip_input(GROUND, input, self.input)
        self._set_wheels(self.input)

    def advance(self) -> None:
        """To the next sample, `SAMPLE_TIME` s on."""
        before = self._true_pose()
        touches = self._run_sample(bool(self.input.any()))
        self.collisions += touches and not self._touches
        self._touches = touches
        pose = self._true_pose()
        self.driven += math.dist(before[:2], pose[:2])
        self.true = self._true_state()
        self.measured = self.estimator.feel(self._wheels(), wrap(pose[2] - before[2]) / SAMPLE_TIME, pose)
        self.closest = min(self.closest, float(self._clearance(pose[:2])))


class SpinningLidar:
    """A lidar that looks round once in so many samples, beam after beam: what it tells is of different times.

    With the sensor's own errors; a beam that hits nothing reports inf, one that hits too near -inf (REP 117).
    """

    def __init__(
        self,
        arena: Arena,
        rng: np.random.Generator,
        noise: float,
        beams: int = 360,
        nearest: float = 0.12,
        farthest: float = 3.5,
        mount: float = -0.032,
    ) -> None:
        """noise: m, sigma of a range; nearest, farthest: m; mount: m, its place along the robot's x axis."""
        self.nearest, self.farthest, self.mount = nearest, farthest, mount
        self.gap = 2.0 * math.pi / beams
        angles = self.gap * np.arange(beams)
        directions = np.stack([np.cos(angles), np.sin(angles)], axis=1)
        self._sectors = [
            Lidar(arena, LidarRays(part, farthest), noise, rng) for part in np.array_split(directions, SAMPLES)
        ]
        self._seen: list[Array] = []

    def look(self, true: Array) -> Array | None:
        """The next sector from a true state (5,); all ranges (beams,) [m] when a turn is complete."""
        heading = float(true[2])
        place = true[:2] + self.mount * np.array([math.cos(heading), math.sin(heading)])
        sector = self._sectors[len(self._seen)]
        ranges = sector.ranges(place, heading)
        ranges = np.where(ranges >= self.farthest, np.inf, np.where(ranges < self.nearest, -np.inf, ranges))
        self._seen.append(ranges)
        if len(self._seen) < len(self._sectors):
            return None
        whole, self._seen = np.concatenate(self._seen), []
        return whole

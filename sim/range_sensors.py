"""The range sensors that free space comes from, and their faults.

On the ground: 360 beams around the robot, as a TurtleBot3's LDS-01. In the air: beams in all directions, as two
hemispherical lidars thinned to a grid.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from dataclasses import replace
from typing import Any, Generic, TypeVar

import numpy as np

from brakeline.messaging.obstacle import Array
from brakeline.messaging.range_image import RangeImage, directions
from brakeline.messaging.ray_directions import LidarRays
from brakeline.messaging.robot import Robot
from brakeline.messaging.scan import Scan
from brakeline.sim.arena import Arena
from brakeline.sim.ground_estimator import CUT
from brakeline.sim.lidar import Lidar
from brakeline.sim.sim_conditions import Perception, SensorFaults
from brakeline.sim.traffic import Crowd

S = TypeVar("S", Scan, RangeImage)


def with_faults(
    ranges: Array, azimuths: Array, limits: tuple[float, float], faults: SensorFaults, rng: np.random.Generator
) -> Array:
    """Return ranges (R,) [m] with the faults of a sensor; 0 for a beam without information.

    Args:
        ranges: of a sensor without faults; 0 for a beam without information.
        azimuths (R,): directions of the beams [rad], 0 ahead, up to whole turns.
        limits: smallest and largest range [m].
        faults: what to draw, and from rng.
    """
    (near, far), draw, count = limits, rng.random, len(ranges)
    if faults.far:
        ranges = np.where((draw(count) < faults.far) & (ranges > 0.0), far, ranges)
    if faults.ghosts:
        ghosts = np.maximum(near, ranges * draw(count))
        ranges = np.where((draw(count) < faults.ghosts) & (ranges > 0.0), ghosts, ranges)
    if faults.dropped:
        ranges = np.where(draw(count) < faults.dropped, 0.0, ranges)
    if faults.blind:
        ahead = np.abs(np.mod(azimuths + math.pi, 2.0 * math.pi) - math.pi)
        ranges = np.where(ahead > math.pi - 0.5 * faults.blind, 0.0, ranges)
    return np.asarray(ranges)


class Scanner(ABC, Generic[S]):
    """One robot's range sensor in one episode."""

    DIRECTIONS: Array  # (R, d) unit vectors of the beams
    NEAR: float  # m; nearer ranges are reported as 0
    FAR: float  # m, largest range
    LEAST_WIDTH: float  # m, of every obstacle in the arenas

    def __init__(
        self, robot: Robot, arena: Arena, rng: np.random.Generator, noise: float, perception: Perception
    ) -> None:
        """noise: standard deviation of a range [m]."""
        self._robot, self._faults, self._rng = robot, perception.faults, rng
        self._lidar = Lidar(arena, LidarRays(self.DIRECTIONS, self.FAR), noise, rng)
        self._azimuths = np.arctan2(self.DIRECTIONS[:, 1], self.DIRECTIONS[:, 0])
        movers = arena.crowd.kind if isinstance(arena.crowd, Crowd) else None
        self._tracked = movers if perception.tracks else None
        self._limits: dict[str, Any] = {
            "far": self.FAR,
            "range_error": CUT * noise,
            "position_error": math.hypot(*robot.measurement_bound[: robot.position_dim]),
            "least_width": self.LEAST_WIDTH,
            "doubt": int(self._faults.far > 0.0),
            "speed": movers.speed if movers else 0.0,
        }
        self._queue: list[S] = []

    def scan(self, true: Array, measured: Array, time: float) -> S:
        """Return the newest scan that has arrived at a time [s]. Call it once a period.

        Args:
            true: (n,) true state, only to place the sensor.
            measured: (n,) measured state, the pose that the scan carries.
        """
        self._lidar.move_obstacles(time)
        self._queue.append(self._take_scan(true, measured))
        if len(self._queue) > self._faults.late + 1:
            self._queue.pop(0)
        return replace(self._queue[0], age=self._robot.period * (len(self._queue) - 1))

    @abstractmethod
    def _take_scan(self, true: Array, measured: Array) -> S:
        """Take a scan now."""

    def _faulty(self, ranges: Array) -> Array:
        """Return ranges with the sensor's faults."""
        ranges = np.where(ranges < self.NEAR, 0.0, ranges)
        return with_faults(ranges, self._azimuths, (self.NEAR, self._lidar.max_range), self._faults, self._rng)


class FanScanner(Scanner[Scan]):
    """A scanner in the plane, as the LDS-01."""

    ANGLES = np.linspace(-math.pi, math.pi, 360, endpoint=False)
    DIRECTIONS = np.stack([np.cos(ANGLES), np.sin(ANGLES)], axis=1)
    NEAR, FAR, LEAST_WIDTH = 0.12, 3.5, 0.1
    MOUNT = (-0.032, 0.0)  # m in the robot's frame

    def _take_scan(self, true: Array, measured: Array) -> Scan:
        index = self._robot.heading
        assert index is not None
        x, y, heading = float(true[0]), float(true[1]), float(true[index])
        cos, sin, (mx, my) = math.cos(heading), math.sin(heading), self.MOUNT
        origin = np.array([x + cos * mx - sin * my, y + sin * mx + cos * my])
        return Scan(
            self._faulty(self._lidar.ranges(origin, heading)),
            self.ANGLES,
            (float(measured[0]), float(measured[1]), float(measured[index])),
            self.MOUNT,
            heading_error=self._robot.measurement_bound[index],
            acceleration=self._tracked.acceleration if self._tracked else 0.0,
            least_radius=self._tracked.radius if self._tracked else 0.0,
            **self._limits,
        )


class DomeScanner(Scanner[RangeImage]):
    """A scanner in all directions. It reports beams in the world's frame, turned back by an inexact attitude."""

    RINGS, COLUMNS = 90, 180  # one beam every 2°
    LOW = -0.5 * math.pi * (1.0 - 1.0 / RINGS)  # rad, elevation of the lowest ring
    DIRECTIONS = directions(np.linspace(LOW, -LOW, RINGS), COLUMNS).reshape(-1, 3)
    NEAR, FAR, LEAST_WIDTH = 0.2, 20.0, 0.8
    TILT_ERROR = 0.01  # rad, largest error of the attitude

    def _take_scan(self, true: Array, measured: Array) -> RangeImage:
        ranges = self._faulty(self._lidar.ranges(true[:3], _random_rotation(self._rng, self.TILT_ERROR)))
        return RangeImage(
            ranges.reshape(self.RINGS, self.COLUMNS),
            (float(measured[0]), float(measured[1]), float(measured[2])),
            low=self.LOW,
            high=-self.LOW,
            angle_error=self.TILT_ERROR,
            **self._limits,
        )


def _random_rotation(rng: np.random.Generator, most: float) -> Array:
    """Draw a rotation matrix (3, 3) by at most `most` rad about a random axis (Rodrigues' formula)."""
    axis = rng.normal(size=3)
    x, y, z = axis / np.linalg.norm(axis)
    angle = float(rng.uniform(0.0, most))
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return np.asarray(np.eye(3) + math.sin(angle) * cross + (1.0 - math.cos(angle)) * cross @ cross)


def make_scanner(
    robot: Robot, arena: Arena, rng: np.random.Generator, noise: float, perception: Perception
) -> FanScanner | DomeScanner:
    """Return the scanner of a robot in the plane or in space.

    Raises:
        ValueError: the robot cannot carry a scanner, or the conditions ask for tracks in space.
    """
    if robot.position_dim == 3:
        if perception.tracks:
            raise ValueError("no tracker works in space: leave out --tracks")
        return DomeScanner(robot, arena, rng, noise, perception)
    if robot.heading is None:
        raise ValueError(f"{robot.name} has no heading, so it cannot carry a scanner; use --perception map")
    return FanScanner(robot, arena, rng, noise, perception)

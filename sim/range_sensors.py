"""The ranging sensors that free space is made of, and what ails them: on the ground 360 beams round the robot, as on a
TurtleBot3; in the air beams all about, as of two hemispherical lidars, thinned to a grid."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from dataclasses import replace
from typing import Generic, TypeVar

import numpy as np
from numpy.typing import NDArray

from brakeline.messaging.range_image import RangeImage, directions
from brakeline.messaging.ray_directions import LidarRays
from brakeline.messaging.robot import Robot
from brakeline.messaging.scan import Scan
from brakeline.sim.arena import Arena
from brakeline.sim.lidar import Lidar
from brakeline.sim.sim_conditions import Perception as Perception
from brakeline.sim.sim_conditions import SensorFaults as SensorFaults
from brakeline.sim.traffic import Crowd

Array = NDArray[np.float64]
S = TypeVar("S", Scan, RangeImage)

CUT = 2.0  # sigma: the noise of a range is cut off there


class Scanner(ABC, Generic[S]):
    """One robot's sensor in one episode."""

    def __init__(
        self,
        robot: Robot,
        arena: Arena,
        rays: LidarRays,
        near: float,
        rng: np.random.Generator,
        noise: float,
        perception: Perception,
    ) -> None:
        """near [m]: what is nearer is not measured; noise: m, sigma of a range."""
        faults = perception.faults
        self._faults, self._rng, self._noise, self._near = faults, rng, noise, near
        self._lidar = Lidar(arena, rays, noise, rng)
        self._azimuths = np.arctan2(rays.directions[:, 1], rays.directions[:, 0])
        self._position_error = math.hypot(*robot.measurement_bound[: robot.position_dim])
        self._period = robot.period
        movers = arena.crowd.kind if isinstance(arena.crowd, Crowd) else None
        self._speed = movers.speed if movers else 0.0
        self._movers = movers if perception.tracks else None  # and so it is known how they may speed up
        self._waiting: list[S] = []

    def scan(self, true: Array, measured: Array, time: float) -> S:
        """What there is at that time [s], once a period; true: state, for the sensor's place alone."""
        self._lidar.at(time)
        self._waiting.append(self._taken(true, measured))
        if len(self._waiting) > self._faults.late + 1:
            self._waiting.pop(0)
        return replace(self._waiting[0], age=self._period * (len(self._waiting) - 1))

    @abstractmethod
    def _taken(self, true: Array, measured: Array) -> S:
        """A fresh one."""

    def _ailing(self, ranges: Array) -> Array:
        faults, draw, count = self._faults, self._rng.random, len(ranges)
        ranges = np.where(ranges < self._near, 0.0, ranges)
        if faults.far:
            ranges = np.where((draw(count) < faults.far) & (ranges > 0.0), self._lidar.max_range, ranges)
        if faults.ghosts:
            ghosts = np.maximum(self._near, ranges * draw(count))
            ranges = np.where((draw(count) < faults.ghosts) & (ranges > 0.0), ghosts, ranges)
        if faults.dropped:
            ranges = np.where(draw(count) < faults.dropped, 0.0, ranges)
        if faults.blind:
            ranges = np.where(np.abs(self._azimuths) > math.pi - 0.5 * faults.blind, 0.0, ranges)
        return np.asarray(ranges)


class FanScanner(Scanner[Scan]):
    """LDS-01."""

    BEAMS, FAR, NEAR = 360, 3.5, 0.12  # and m that it measures to and from
    MOUNT = (-0.032, 0.0)  # m in the robot's frame
    LEAST_WIDTH = 0.1  # m: of everything in the arenas

    def __init__(
        self, robot: Robot, arena: Arena, rng: np.random.Generator, noise: float, perception: Perception
    ) -> None:
        """Raises ValueError: the robot has no heading."""
        if robot.heading is None:
            raise ValueError(f"{robot.name} has no heading for a fan of beams: its free space comes from the map")
        self._angles = np.linspace(-math.pi, math.pi, self.BEAMS, endpoint=False)
        rays = LidarRays(np.stack([np.cos(self._angles), np.sin(self._angles)], axis=1), self.FAR)
        super().__init__(robot, arena, rays, self.NEAR, rng, noise, perception)
        self._heading, self._heading_error = robot.heading, robot.measurement_bound[robot.heading]

    def _taken(self, true: Array, measured: Array) -> Scan:
        x, y, heading = float(true[0]), float(true[1]), float(true[self._heading])
        cos, sin, (mx, my) = math.cos(heading), math.sin(heading), self.MOUNT
        at = np.array([x + cos * mx - sin * my, y + sin * mx + cos * my])
        return Scan(
            self._ailing(self._lidar.ranges(at, heading)),
            self._angles,
            (float(measured[0]), float(measured[1]), float(measured[self._heading])),
            self.MOUNT,
            far=self.FAR,
            range_error=CUT * self._noise,
            position_error=self._position_error,
            heading_error=self._heading_error,
            least_width=self.LEAST_WIDTH,
            doubt=int(self._faults.far > 0.0),
            speed=self._speed,
            acceleration=self._movers.acceleration if self._movers else 0.0,
            least_radius=self._movers.radius if self._movers else 0.0,
        )


class DomeScanner(Scanner[RangeImage]):
    """All about. The beams are told in the world's frame: turned back by an attitude that is a little wrong."""

    RINGS, COLUMNS, FAR, NEAR = 90, 180, 20.0, 0.2  # every 2°, and m that it measures to and from
    LOW = -0.5 * math.pi * (1.0 - 1.0 / RINGS)  # rad: the lowest ring
    LEAST_WIDTH = 0.8  # m: of everything in the arenas
    TILT = 0.01  # rad: largest error of the attitude

    def __init__(
        self, robot: Robot, arena: Arena, rng: np.random.Generator, noise: float, perception: Perception
    ) -> None:
        beams = directions(np.linspace(self.LOW, -self.LOW, self.RINGS), self.COLUMNS)
        if perception.tracks:
            raise ValueError("in space nothing is followed from scan to scan: leave out --tracks")
        super().__init__(robot, arena, LidarRays(beams.reshape(-1, 3), self.FAR), self.NEAR, rng, noise, perception)

    def _taken(self, true: Array, measured: Array) -> RangeImage:
        ranges = self._ailing(self._lidar.ranges(true[:3], _tilt(self._rng, self.TILT)))
        return RangeImage(
            ranges.reshape(self.RINGS, self.COLUMNS),
            (float(measured[0]), float(measured[1]), float(measured[2])),
            low=self.LOW,
            high=-self.LOW,
            far=self.FAR,
            range_error=CUT * self._noise,
            position_error=self._position_error,
            angle_error=self.TILT,
            least_width=self.LEAST_WIDTH,
            doubt=int(self._faults.far > 0.0),
            speed=self._speed,
        )


def _tilt(rng: np.random.Generator, most: float) -> Array:
    """A turn (3, 3) by up to so many rad about any axis (Rodrigues)."""
    axis = rng.normal(size=3)
    x, y, z = axis / np.linalg.norm(axis)
    angle = float(rng.uniform(0.0, most))
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return np.asarray(np.eye(3) + math.sin(angle) * cross + (1.0 - math.cos(angle)) * cross @ cross)


def make_scanner(
    robot: Robot, arena: Arena, rng: np.random.Generator, noise: float, perception: Perception
) -> FanScanner | DomeScanner:
    """The sensor of a robot in the plane, or in space. Raises ValueError: it can have none."""
    return (FanScanner if robot.position_dim == 2 else DomeScanner)(robot, arena, rng, noise, perception)

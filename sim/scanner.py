"""The ranging sensor that free space is made of: 360 beams round the robot, as on a TurtleBot3, and what ails them."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from messaging.rays import Rays
from messaging.robots import Robot
from messaging.scans import Scan
from sim.conditions import Faults as Faults
from sim.conditions import Perception as Perception
from sim.lidar import Lidar
from sim.movers import Crowd
from sim.world import Arena

Array = NDArray[np.float64]

BEAMS, FAR, NEAR = 360, 3.5, 0.12  # LDS-01: beams, and m that it measures from and to
MOUNT = (-0.032, 0.0)  # m in the robot's frame
LEAST_WIDTH = 0.1  # m: of everything in the arenas
CUT = 2.0  # sigma: the noise of a range is cut off there


class Scanner:
    """One robot's sensor in one episode."""

    def __init__(
        self, robot: Robot, arena: Arena, rng: np.random.Generator, noise: float, faults: Faults | None = None
    ) -> None:
        """noise: m, sigma of a range. Raises ValueError for a robot that is not in the plane."""
        if robot.position_dim != 2 or robot.heading is None:
            raise ValueError(f"{robot.name} has no fan of beams in the plane: its free space comes from the map")
        self._faults, self._rng, self._noise = faults or Faults(), rng, noise
        self._angles = np.linspace(-math.pi, math.pi, BEAMS, endpoint=False)
        directions = np.stack([np.cos(self._angles), np.sin(self._angles)], axis=1)
        self._lidar = Lidar(arena, Rays(directions, FAR), noise, rng)
        bound = robot.measurement_bound
        self._position_error, self._heading_error = math.hypot(*bound[:2]), bound[robot.heading]
        self._period, self._heading = robot.period, robot.heading
        self._speed = arena.crowd.kind.speed if isinstance(arena.crowd, Crowd) else 0.0
        self._waiting: list[Scan] = []

    def scan(self, true: Array, measured: Array, time: float) -> Scan:
        """What there is at that time [s], once a period; true: state, for the sensor's place alone."""
        x, y, heading = float(true[0]), float(true[1]), float(true[self._heading])
        cos, sin = math.cos(heading), math.sin(heading)
        at = np.array([x + cos * MOUNT[0] - sin * MOUNT[1], y + sin * MOUNT[0] + cos * MOUNT[1]])
        self._lidar.at(time)
        fresh = Scan(
            self._ailing(self._lidar.ranges(at, heading)),
            self._angles,
            (float(measured[0]), float(measured[1]), float(measured[self._heading])),
            MOUNT,
            far=FAR,
            range_error=CUT * self._noise,
            position_error=self._position_error,
            heading_error=self._heading_error,
            least_width=LEAST_WIDTH,
            doubt=int(self._faults.far > 0.0),
            speed=self._speed,
        )
        self._waiting.append(fresh)
        if len(self._waiting) > self._faults.late + 1:
            self._waiting.pop(0)
        oldest = self._waiting[0]
        return replace(oldest, age=self._period * (len(self._waiting) - 1))

    def _ailing(self, ranges: Array) -> Array:
        faults, draw = self._faults, self._rng.random
        ranges = np.where(ranges < NEAR, 0.0, ranges)
        if faults.far:
            ranges = np.where((draw(BEAMS) < faults.far) & (ranges > 0.0), FAR, ranges)
        if faults.ghosts:
            ghosts = np.maximum(NEAR, ranges * draw(BEAMS))
            ranges = np.where((draw(BEAMS) < faults.ghosts) & (ranges > 0.0), ghosts, ranges)
        if faults.dropped:
            ranges = np.where(draw(BEAMS) < faults.dropped, 0.0, ranges)
        if faults.blind:
            ranges = np.where(np.abs(self._angles) > math.pi - 0.5 * faults.blind, 0.0, ranges)
        return np.asarray(ranges)

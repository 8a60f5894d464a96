"""What a ranging sensor with beams all about saw in one turn: the raw material of free space in the air.

A beam that reports a range ρ says: free from the sensor up to ρ, within its error. One that reports nothing (0) says
nothing: too near, dropped, blind. The picture is a grid: rings of the same elevation, columns of the same azimuth.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from brakeline.messaging.obstacle import FARTHEST
from brakeline.messaging.scan import BadScan, check_unit

Array = NDArray[np.float64]

MOST_BEAMS = 40_000
MOST_AROUND = 400_000  # if its rings went on from pole to pole
COARSEST = math.radians(12.0)  # between rings or columns
MOST_TURNED = 0.3  # rad: who knows its attitude no better has no picture of what is about it


@dataclass(frozen=True, eq=False)
class RangeImage:
    """A grid of beams over the sphere.

    ranges (E, A): m, `far` where nothing was hit, 0: not known; row i is a ring of elevation `low + i (high - low) /
    (E - 1)` rad, column j of azimuth `2π j / A`, from straight ahead to the left, in the sensor's frame; what is above
    and below the rings is not seen. at (3,): the robot's measured position, m; attitude: unit quaternion (w, x, y, z),
    the world from the sensor's frame; mount (3,): the sensor's place in its own frame, m. Nothing that it may meet is
    narrower than `least_width`: every point of an obstacle's surface is the corner of a cube with such edges that lies
    in it, as in a box with such edges, a ball of 0.87 of it in radius, an upright cylinder of 0.71 of it in radius that
    is as tall.
    """

    ranges: Array
    at: tuple[float, float, float]
    attitude: tuple[float, float, float, float] = (1.0, 0.0, 0.0, 0.0)
    low: float = -0.5 * math.pi
    high: float = 0.5 * math.pi
    mount: tuple[float, float, float] = (0.0, 0.0, 0.0)
    far: float = 20.0  # m
    range_error: float = 0.05  # m, largest error of a range
    position_error: float = 0.0  # m, of `at`
    angle_error: float = 0.0  # rad, of the attitude: by which all beams are turned, the same way
    least_width: float = 0.5  # m
    doubt: int = 0  # so many of any four neighbouring beams, 0 or 1, may see through what is there
    speed: float = 0.0  # m/s: whatever was hit may move as fast; 0: the world stands
    age: float = 0.0  # s since it was taken

    def __post_init__(self) -> None:
        check_unit(self.ranges)
        object.__setattr__(self, "ranges", np.ascontiguousarray(self.ranges, dtype=float))  # as loops are compiled for
        if self.ranges.ndim != 2 or not all(self.ranges.shape) or self.ranges.size > MOST_BEAMS:
            raise BadScan(f"a range image has rings and columns, of {MOST_BEAMS} beams at most")
        if not np.isfinite(self.ranges).all() or (self.ranges < 0.0).any():
            raise BadScan("a range image's ranges are finite, and 0 or more: `far` where nothing was hit, 0: not known")
        for name in ("at", "attitude", "mount"):
            object.__setattr__(self, name, tuple(map(float, getattr(self, name))))
        if (len(self.at), len(self.attitude), len(self.mount)) != (3, 4, 3):
            raise BadScan("a range image's place and mount have 3 coordinates, its attitude 4")
        if not all(abs(value) <= FARTHEST for value in (*self.at, *self.attitude, *self.mount)):  # NaN fails too
            raise BadScan(f"a range image's place, attitude and mount must be finite, and within {FARTHEST:g}")
        if abs(math.hypot(*self.attitude) - 1.0) > 1e-3:
            raise BadScan("a range image's attitude is a unit quaternion")
        bounds = (self.far, self.range_error, self.position_error, self.angle_error, self.speed, self.age)
        if not all(0.0 <= value <= FARTHEST for value in bounds):
            raise BadScan(f"a range image's errors, speed and age are finite, not negative, and {FARTHEST:g} at most")
        if self.angle_error > MOST_TURNED:
            raise BadScan(f"a range image's angle error is {MOST_TURNED:g} rad at most")
        if not (math.isfinite(self.least_width) and self.least_width > 0.0):
            raise BadScan("a range image's least width must be positive")
        if self.doubt not in (0, 1):
            raise BadScan("of a range image one beam of four is doubted, or none")
        object.__setattr__(self, "doubt", int(self.doubt))
        if not -0.5 * math.pi <= self.low < self.high <= 0.5 * math.pi:
            raise BadScan("a range image's rings go from one elevation up to another, between -90° and 90°")
        if len(self.ranges) < 2 or max(self.step) > COARSEST:
            raise BadScan(f"a range image has rings and columns at most {math.degrees(COARSEST):.0f}° apart")
        if math.pi / self.step[0] * self.ranges.shape[1] > MOST_AROUND:
            raise BadScan(f"a range image's rings are so close that all about there were over {MOST_AROUND} beams")

    @cached_property
    def step(self) -> tuple[float, float]:
        """rad between rings, and between columns."""
        rings, columns = self.ranges.shape
        return (self.high - self.low) / (rings - 1), math.tau / columns

    @cached_property
    def turn(self) -> Array:
        """(3, 3): the world from the sensor's frame."""
        length = math.hypot(*self.attitude)
        w, x, y, z = (float(part) / length for part in self.attitude)
        return np.array(
            [
                [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
                [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
                [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
            ]
        )

    @property
    def known(self) -> NDArray[np.bool_]:
        """Which beams say something."""
        return np.asarray(self.ranges > 0.0)

    @property
    def sensor_error(self) -> float:
        """m, largest error of where the sensor was: a wrong attitude swings it about the robot."""
        return self.position_error + self.angle_error * math.hypot(*self.mount)

    def sensor(self) -> Array:
        """(3,): where the sensor was, by the measured place, m."""
        place: Array = np.asarray(self.at) + self.turn @ np.asarray(self.mount)
        return place


def directions(elevations: NDArray[Any], columns: int, at: NDArray[Any] | None = None) -> Array:
    """(E, A, 3): unit vectors of a grid, in the sensor's frame; at (A,): which of that many columns, or between."""
    around = math.tau / columns * (np.arange(columns) if at is None else at)
    level, up = np.cos(elevations)[:, None], np.sin(elevations)[:, None]
    flat = np.broadcast_to(up, (len(up), len(around)))
    grid: Array = np.stack([level * np.cos(around), level * np.sin(around), flat], axis=-1)
    return grid

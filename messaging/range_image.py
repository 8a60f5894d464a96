"""A range image: one turn of a range sensor with beams in all directions, from which free space in the air is computed.

A beam with a range ρ means: space is free from the sensor up to ρ, within the range error. A beam with 0 has no
information. The image is a grid: rings of equal elevation, columns of equal azimuth.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from brakeline.errors import BadScan
from brakeline.messaging.scan import check_largest, check_numbers, check_unit
from brakeline.messaging.value_equality import ComparedByValue

Array = NDArray[np.float64]

MAX_BEAMS = 40_000
MAX_SPHERE_BEAMS = 400_000  # number of beams if the rings continued from pole to pole
MAX_STEP = math.radians(12.0)  # between rings, and between columns
MAX_ANGLE_ERROR = 0.3  # [rad]; with a larger error an image shows no free space


@dataclass(frozen=True, eq=False)
class RangeImage(ComparedByValue):
    """A range image with E rings and A columns.

    Ring i has the elevation `low + i (high - low) / (E - 1)`, column j the azimuth `2π j / A`, from straight ahead to
    the left, in the sensor's frame. The sensor does not see above and below the rings.

    No obstacle is narrower than `least_width`: each point of an obstacle's surface is the corner of a cube with such
    edges inside the obstacle. This holds for a box with such edges, for a ball with a radius of at least 0.87 times
    that length, and for an upright cylinder of at least that height with a radius of at least 0.71 times that length.

    >>> image = RangeImage(ranges=np.full((45, 90), 20.0), at=(0.0, 0.0, 1.0))
    >>> [round(math.degrees(angle), 2) for angle in image.step]
    [4.09, 4.0]

    Attributes:
        ranges: (E, A) [m]. `far` means no hit; 0 means no information.
        at: measured position of the robot at the time of the image [m].
        attitude: unit quaternion w, x, y, z: world from sensor.
        low: elevation of the lowest ring [rad].
        high: elevation of the highest ring [rad].
        mount: position of the sensor in its own frame [m].
        far: largest range of the sensor [m].
        range_error: largest error of a range [m].
        position_error: largest error of `at` [m].
        angle_error: largest error of the attitude, the same rotation for all beams [rad].
        least_width: see above [m].
        doubt: number of beams, 0 or 1, that may miss an obstacle among any four neighbouring beams.
        speed: largest speed of the surfaces that were hit [m/s]; 0: the world is static.
        age: time since the image [s].
    """

    ranges: Array
    at: tuple[float, float, float]
    attitude: tuple[float, float, float, float] = (1.0, 0.0, 0.0, 0.0)
    low: float = -0.5 * math.pi
    high: float = 0.5 * math.pi
    mount: tuple[float, float, float] = (0.0, 0.0, 0.0)
    far: float = 20.0
    range_error: float = 0.05
    position_error: float = 0.0
    angle_error: float = 0.0
    least_width: float = 0.5
    doubt: int = 0
    speed: float = 0.0
    age: float = 0.0

    def __hash__(self) -> int:
        return hash((self.ranges.shape, self.far, self.age))

    def __post_init__(self) -> None:
        check_unit(self.ranges)
        # A masked beam has no information. Compiled functions expect contiguous double precision.
        object.__setattr__(self, "ranges", np.ascontiguousarray(np.ma.filled(self.ranges, 0.0), dtype=float))
        if self.ranges.ndim != 2 or not all(self.ranges.shape) or self.ranges.size > MAX_BEAMS:
            raise BadScan(f"a range image has rings and columns, of {MAX_BEAMS} beams at most")
        if not np.isfinite(self.ranges).all() or (self.ranges < 0.0).any():
            raise BadScan("a range image's ranges are finite, and 0 or more: `far` for no hit, 0 for no information")
        for name in ("at", "attitude", "mount"):
            object.__setattr__(self, name, tuple(map(float, getattr(self, name))))
        if (len(self.at), len(self.attitude), len(self.mount)) != (3, 4, 3):
            raise BadScan("a range image's place and mount have 3 coordinates, its attitude 4")
        bounds = (self.range_error, self.position_error, self.angle_error, self.speed, self.age)
        check_numbers("range image", (*self.at, *self.attitude, *self.mount), self.far, bounds, self.least_width)
        check_largest(self.ranges, self.far)
        if abs(math.hypot(*self.attitude) - 1.0) > 1e-3:
            raise BadScan("a range image's attitude is a unit quaternion")
        if self.angle_error > MAX_ANGLE_ERROR:
            raise BadScan(f"a range image's angle error is {MAX_ANGLE_ERROR:g} rad at most")
        if self.doubt not in (0, 1):
            raise BadScan("a range image's doubt is 0 or 1")
        object.__setattr__(self, "doubt", int(self.doubt))
        if not -0.5 * math.pi <= self.low < self.high <= 0.5 * math.pi:
            raise BadScan("a range image's rings go from one elevation up to another, between -90° and 90°")
        if len(self.ranges) < 2 or max(self.step) > MAX_STEP:
            raise BadScan(f"a range image has rings and columns at most {math.degrees(MAX_STEP):.0f}° apart")
        if math.pi / self.step[0] * self.ranges.shape[1] > MAX_SPHERE_BEAMS:
            raise BadScan(
                f"a range image's rings are so close that a full sphere would have over {MAX_SPHERE_BEAMS} beams"
            )

    @cached_property
    def step(self) -> tuple[float, float]:
        """Angles between rings and between columns [rad]."""
        rings, columns = self.ranges.shape
        return (self.high - self.low) / (rings - 1), math.tau / columns

    @cached_property
    def rotation(self) -> Array:
        """Rotation matrix (3, 3), world from sensor."""
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
    def valid_beams(self) -> NDArray[np.bool_]:
        """Whether each beam (E, A) has information."""
        return np.asarray(self.ranges > 0.0)

    @property
    def sensor_error(self) -> float:
        """Largest error of the sensor's position [m]; an angle error moves a mounted sensor about the robot."""
        return self.position_error + self.angle_error * math.hypot(*self.mount)

    def sensor(self) -> Array:
        """Return the sensor's position (3,) [m], by the measured position and attitude."""
        position: Array = np.asarray(self.at) + self.rotation @ np.asarray(self.mount)
        return position


def directions(elevations: NDArray[Any], columns: int, at: NDArray[Any] | None = None) -> Array:
    """Return unit vectors (E, A, 3) of a grid of beams in the sensor's frame.

    Args:
        elevations: of the rings (E,) [rad].
        columns: number of columns of a full turn.
        at: column numbers (A,), which may be fractions; all columns by default.
    """
    around = math.tau / columns * (np.arange(columns) if at is None else at)
    level, up = np.cos(elevations)[:, None], np.sin(elevations)[:, None]
    flat = np.broadcast_to(up, (len(up), len(around)))
    grid: Array = np.stack([level * np.cos(around), level * np.sin(around), flat], axis=-1)
    return grid

"""A planar scan: the ranges of one turn of a range sensor. Without a map, the filter computes free space from it.

A beam with a range ρ means: space is free from the sensor up to ρ, within the range error. A beam with 0 or NaN has no
information: the obstacle was too near, the reflection was lost, or the sensor is blind there. The visibility memory
(`safety/perception/visibility_memory.py`) fills such beams with space that was free before.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from brakeline.errors import BadScan
from brakeline.messaging.obstacle import FARTHEST, Array
from brakeline.messaging.value_equality import ComparedByValue

MAX_BEAMS = 1000
MAX_FAR = 1000.0  # largest range of a sensor [m]: a larger one is in mm
BEYOND_FAR = 10.0  # times `far`; a larger range must be in mm
MAX_LEAST_WIDTH = 5.0  # of obstacles [m]
MAX_SCAN_AGE = 2.0  # age from which a scan or range image shows no free space any more [s]
MAX_TRACK_VALUE = 1e4  # largest speed [m/s], error [m/s] and acceleration [m/s²] of a track


def check_unit(ranges: object) -> None:
    """Refuse ranges that may be in millimetres, as depth cameras give them.

    Raises:
        BadScan: the array has an integer type.
    """
    if isinstance(ranges, np.ndarray) and ranges.dtype.kind in "iu":
        raise BadScan(f"ranges are in m: an array of {ranges.dtype} may be in mm; divide, or give `.astype(float)`")


def check_largest(ranges: Array, far: float) -> None:
    """Refuse ranges far beyond `far` [m], which means no hit. If they were in mm, all would mean free space.

    Raises:
        BadScan: a range is over `BEYOND_FAR` times `far`.
    """
    if (largest := float(np.nan_to_num(ranges).max(initial=0.0))) > BEYOND_FAR * far:
        raise BadScan(f"a range of {largest:g} m with `far` {far:g} m: give both in m, and `far` for no hit")


def check_numbers(
    name: str, coordinates: Iterable[float], far: float, bounds: Iterable[float], least_width: float
) -> None:
    """Check the numbers that scans and range images have in common.

    Args:
        name: "scan" or "range image".
        far: largest range [m].
        coordinates: of the pose and the mount.
        bounds: errors, speeds, times and other values that are not negative.

    Raises:
        BadScan: a number is not finite, or out of bounds.
    """
    if not all(abs(value) <= FARTHEST for value in coordinates):  # NaN fails too
        raise BadScan(f"a {name}'s pose, attitude and mount must be finite, and within {FARTHEST:g}")
    if not all(0.0 <= value <= FARTHEST for value in bounds):
        raise BadScan(f"a {name}'s errors, speed and age must be finite, not negative, and {FARTHEST:g} at most")
    if not 0.0 <= far <= MAX_FAR:
        raise BadScan(f"a {name}'s `far` is finite, and from 0 to {MAX_FAR:g} m, not {far:g}: give it in m")
    if not 0.0 < least_width <= MAX_LEAST_WIDTH:  # one in mm would free nearly all space between two beams
        why = f"above 0 m, and {MAX_LEAST_WIDTH:g} m at most"
        raise BadScan(f"a {name}'s least width is {why}, not {least_width:g}: give it in m; less is safer")


@dataclass(frozen=True, eq=False)
class BeamTracks(ComparedByValue):
    """The tracked motion of the surfaces that a scan hit (`safety/perception/scan_tracking.py`)."""

    # (R,) for each beam, the row in `motions` of the surface that it hit, counted from 1. 0: the surface is not tracked
    # and may move in any direction at the scan's speed.
    track_index: NDArray[np.uint8]
    # (K, 4) velocity x, y in the world [m/s], its error [m/s], and the largest acceleration [m/s²]. t seconds after the
    # scan the displacement is velocity·t, within error·t + acceleration·t²/2.
    motions: Array

    def __hash__(self) -> int:
        return hash(self.motions.shape)

    def problem(self, beams: int) -> str:
        """Return the reason why these tracks do not fit a scan with so many beams; empty if they fit."""
        if self.track_index.shape != (beams,) or self.track_index.dtype != np.uint8:
            return "a scan's tracks need one byte for each beam"
        if self.motions.ndim != 2 or self.motions.shape[1] != 4:
            return "a track's motion has four numbers"
        if int(self.track_index.max(initial=0)) > len(self.motions):
            return "a beam's track index is larger than the number of tracks"
        if not (np.abs(self.motions) <= MAX_TRACK_VALUE).all() or (self.motions[:, 2:] < 0.0).any():  # NaN fails too
            return f"a track's numbers must be within {MAX_TRACK_VALUE:g}, its error and acceleration not negative"
        return ""


@dataclass(frozen=True, eq=False)
class Scan(ComparedByValue):
    """A scan in the plane with R beams.

    No obstacle is narrower than `least_width`: from each point of an obstacle's surface, two edges of that length at a
    right angle lie in the obstacle. This holds for a box with such edges, and for a disc with a radius of at least √½
    times that length.

    >>> scan = Scan(ranges=np.full(360, 3.5), angles=np.radians(np.arange(360)), pose=(0.0, 0.0, 0.0))
    >>> bool(scan.valid_beams.all())
    True

    Attributes:
        ranges: (R,) [m]. `far` means no hit; 0 or NaN means no information.
        angles: (R,) in the sensor's frame, ascending, over less than a turn [rad].
        pose: measured pose of the robot at the time of the scan: x, y [m], heading [rad], in the frame of the state.
        mount: position of the sensor in the robot's frame [m].
        far: largest range of the sensor [m].
        range_error: largest error of a range [m].
        position_error: largest error of the pose's position [m].
        heading_error: largest error of the pose's heading [rad].
        least_width: see above [m].
        doubt: number of beams on either side that must agree that space is free, so that one false range has no effect.
        speed: largest speed of the surfaces that were hit [m/s]; 0: the world is static.
        age: time since the scan [s].
        acceleration: largest acceleration of moving obstacles [m/s²]; 0: unknown.
        least_radius: least radius of moving obstacles [m].
        tracks: the tracks of the surfaces that the beams hit; None without tracking.
    """

    ranges: Array
    angles: Array
    pose: tuple[float, float, float]
    mount: tuple[float, float] = (0.0, 0.0)
    far: float = 3.5
    range_error: float = 0.02
    position_error: float = 0.0
    heading_error: float = 0.0
    least_width: float = 0.1
    doubt: int = 0
    speed: float = 0.0
    age: float = 0.0
    acceleration: float = 0.0
    least_radius: float = 0.0
    tracks: BeamTracks | None = None

    def __hash__(self) -> int:
        return hash((self.ranges.shape, self.far, self.age))

    def __post_init__(self) -> None:
        check_unit(self.ranges)
        object.__setattr__(self, "ranges", np.ma.filled(self.ranges, 0.0))  # a masked beam has no information
        for name in ("ranges", "angles"):
            object.__setattr__(self, name, np.asarray(getattr(self, name), dtype=float))
        n = self.ranges.size
        if self.ranges.shape != (n,) or self.angles.shape != (n,) or n > MAX_BEAMS:
            raise BadScan(f"a scan has as many ranges as angles, {MAX_BEAMS} at most")
        if not np.isfinite(self.angles).all() or (np.diff(self.angles) <= 0.0).any():
            raise BadScan("a scan's angles must be finite and ascend: sort them, together with the ranges")
        if n and self.angles[-1] - self.angles[0] >= 4.0 * math.pi:
            raise BadScan(f"a scan's angles reach from {self.angles[0]:g} to {self.angles[-1]:g}: give them in rad")
        if n and self.angles[-1] - self.angles[0] >= 2.0 * math.pi:
            raise BadScan("a scan's angles [rad] span less than a turn: leave out a last beam that repeats the first")
        if np.isinf(self.ranges).any():
            raise BadScan("a scan's ranges are finite: `far` without a hit, 0 or NaN without information")
        if (np.nan_to_num(self.ranges, nan=0.0) < 0.0).any():
            raise BadScan("a scan's ranges are 0 or more")
        for name in ("pose", "mount"):  # copied: the caller may overwrite its arrays
            object.__setattr__(self, name, tuple(map(float, getattr(self, name))))
        if len(self.pose) != 3 or len(self.mount) != 2:
            raise BadScan("a scan's pose has 3 coordinates, its mount 2")
        bounds = (self.range_error, self.position_error, self.heading_error, self.speed, self.age)
        more = (self.doubt, self.acceleration, self.least_radius)
        check_numbers("scan", (*self.pose, *self.mount), self.far, (*bounds, *more), self.least_width)
        check_largest(self.ranges, self.far)
        if self.doubt != int(self.doubt):
            raise BadScan("a scan's doubt is a whole number of beams")
        object.__setattr__(self, "doubt", int(self.doubt))
        if self.tracks is not None and (problem := self.tracks.problem(n)):
            raise BadScan(problem)

    @property
    def valid_beams(self) -> NDArray[np.bool_]:
        """Whether each beam (R,) has information."""
        return np.asarray(self.ranges > 0.0)

    @property
    def sensor_error(self) -> float:
        """Largest error of the sensor's position [m]; a heading error moves a mounted sensor about the robot."""
        return self.position_error + self.heading_error * math.hypot(*self.mount)

    def sensor(self) -> tuple[Array, float]:
        """Return the sensor's position (2,) [m] and heading [rad], by the measured pose."""
        x, y, heading = self.pose
        cos, sin = math.cos(heading), math.sin(heading)
        mx, my = self.mount
        return np.array([x + cos * mx - sin * my, y + sin * mx + cos * my]), heading

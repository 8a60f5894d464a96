"""What a ranging sensor saw in one turn: the raw material of free space where there is no map.

A beam that reports a range ρ says: free from the sensor up to ρ, within its error. One that reports nothing (0, or NaN)
says nothing: too near, dropped, blind. Memory fills such beams in (`safety/perception/visibility_memory.py`) with
what was seen free before.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from brakeline.messaging.obstacle import FARTHEST

Array = NDArray[np.float64]

MOST_BEAMS = 1000
OLDEST = 2.0  # s: what a scan or range image showed to be free is not taken to be so any longer
FASTEST = 1e4  # m/s, m/s²: nothing that is followed goes or speeds up faster


class BadScan(ValueError):
    """A scan that is none."""

    field = "scan"


def check_unit(ranges: object) -> None:
    """Raises BadScan for an array of whole numbers: a depth camera's millimetres, which in m were free space."""
    if isinstance(ranges, np.ndarray) and ranges.dtype.kind in "iu":
        raise BadScan(f"ranges are in m: an array of {ranges.dtype} may be in mm; divide, or give `.astype(float)`")


@dataclass(frozen=True, eq=False)
class BeamTracks:
    """What earlier scans say of where whatever was hit goes (`safety/perception/scan_tracking.py`).

    which (R,): of each beam, the row of `ways` that what it hit keeps to, from 1 on; 0: none, it may go anywhere at the
    scan's speed. ways (K, 4): velocity x, y [m/s, world], how wrong it may be [m/s], largest acceleration [m/s²]: t
    seconds after the scan it has gone by the velocity times t, give or take error·t + acceleration·t²/2.
    """

    track_index: NDArray[np.uint8]
    motions: Array

    def wrong(self, beams: int) -> str:
        """What is wrong with it, of a scan of so many beams; empty: nothing."""
        if self.track_index.shape != (beams,) or self.track_index.dtype != np.uint8:
            return "a scan's tracks need one byte for each beam"
        if self.motions.ndim != 2 or self.motions.shape[1] != 4:
            return "a track's motion has four numbers"
        if int(self.track_index.max(initial=0)) > len(self.motions):
            return "a beam's track index is larger than the number of tracks"
        if not (np.abs(self.motions) <= FASTEST).all() or (self.motions[:, 2:] < 0.0).any():  # NaN fails too
            return f"the numbers of a track's motion must be within {FASTEST:g}, and its last two not negative"
        return ""


@dataclass(frozen=True, eq=False)
class Scan:
    """A fan in the plane.

    ranges (R,): m, `far` where nothing was hit, 0: not known; angles (R,): rad in the sensor's frame, ascending, less
    than a turn; pose: the robot's measured x, y [m] and heading [rad] when it was taken; mount: the sensor's place in
    the robot, m. Nothing that it may meet is narrower than `least_width`: from every point of an obstacle's surface two
    edges of that length at right angles lie in it, as in every corner of a box with such edges, or in a disc of √½ of
    it or more in radius.
    """

    ranges: Array
    angles: Array
    pose: tuple[float, float, float]
    mount: tuple[float, float] = (0.0, 0.0)
    far: float = 3.5  # m
    range_error: float = 0.02  # m, largest error of a range
    position_error: float = 0.0  # m, of the pose
    heading_error: float = 0.0  # rad, of the pose
    least_width: float = 0.1  # m
    doubt: int = 0  # this many beams on either side must agree that something is free: lone false ranges do no harm
    speed: float = 0.0  # m/s: whatever was hit may move as fast; 0: the world stands
    age: float = 0.0  # s since it was taken
    acceleration: float = 0.0  # m/s²: no more than that whatever moves speeds up or slows down; 0: not known
    least_radius: float = 0.0  # m: whatever moves is at least as large
    tracks: BeamTracks | None = None

    def __post_init__(self) -> None:
        check_unit(self.ranges)
        for name in ("ranges", "angles"):
            object.__setattr__(self, name, np.asarray(getattr(self, name), dtype=float))
        n = self.ranges.size
        if self.ranges.shape != (n,) or self.angles.shape != (n,) or n > MOST_BEAMS:
            raise BadScan(f"a scan has as many ranges as angles, {MOST_BEAMS} at most")
        if not np.isfinite(self.angles).all() or (np.diff(self.angles) <= 0.0).any():
            raise BadScan("a scan's angles must be finite and ascend")
        if n and self.angles[-1] - self.angles[0] >= 2.0 * math.pi:
            raise BadScan("a scan's angles [rad] span less than a turn: leave out a last beam that is the first again")
        if np.isinf(self.ranges).any():
            raise BadScan("a scan's ranges are finite: `far` where nothing was hit, 0 or NaN where nothing is known")
        if (np.nan_to_num(self.ranges, nan=0.0) < 0.0).any():
            raise BadScan("a scan's ranges are 0 or more")
        if len(self.pose) != 3 or len(self.mount) != 2:
            raise BadScan("a scan's pose has 3 coordinates, its mount 2")
        values = (*self.pose, *self.mount)
        bounds = [self.far, self.range_error, self.position_error, self.heading_error, self.speed, self.age, self.doubt]
        bounds += [self.acceleration, self.least_radius]
        if not all(abs(value) <= FARTHEST for value in values):  # NaN fails too
            raise BadScan(f"a scan's pose and mount must be finite, and within {FARTHEST:g}")
        if not all(0.0 <= value <= FARTHEST for value in bounds):
            raise BadScan(f"a scan's errors, speed and age must be finite, not negative, and {FARTHEST:g} at most")
        if self.doubt != int(self.doubt):
            raise BadScan("a scan's doubt is a whole number of beams")
        object.__setattr__(self, "doubt", int(self.doubt))
        if not (math.isfinite(self.least_width) and self.least_width > 0.0):
            raise BadScan("a scan's least width must be positive")
        if self.tracks is not None and (wrong := self.tracks.wrong(n)):
            raise BadScan(wrong)

    @property
    def known(self) -> NDArray[np.bool_]:
        """Which beams say something."""
        return np.asarray(self.ranges > 0.0)

    @property
    def sensor_error(self) -> float:
        """m, largest error of where the sensor was: a wrong heading swings it about the robot."""
        return self.position_error + self.heading_error * math.hypot(*self.mount)

    def sensor(self) -> tuple[Array, float]:
        """Where the sensor was, by the measured pose: place (2,) and heading."""
        x, y, heading = self.pose
        cos, sin = math.cos(heading), math.sin(heading)
        mx, my = self.mount
        return np.array([x + cos * mx - sin * my, y + sin * mx + cos * my]), heading

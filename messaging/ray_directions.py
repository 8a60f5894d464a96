"""The directions of a lidar's rays. An observation begins with their ranges, in this order."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


@dataclass(frozen=True)
class LidarRays:
    """The rays of a lidar."""

    directions: Array  # unit vectors (rays, d) in the robot's frame
    range: float  # distance that is observed as 1 [m]


def planar_rays(count: int, degrees: float, range: float) -> LidarRays:
    """Return `count` rays that evenly span an angle about straight ahead, from right to left."""
    spread = math.radians(degrees)
    angles = np.linspace(-0.5 * spread, 0.5 * spread, count)
    return LidarRays(np.stack([np.cos(angles), np.sin(angles)], axis=1), range)


def spherical_rays(azimuths: int, elevations: int, degrees: float, range: float) -> LidarRays:
    """Return rays at azimuths over 360°, from straight ahead. At each azimuth, elevations ascend over `degrees`."""
    spread = math.radians(degrees)
    around = 2.0 * math.pi * np.arange(azimuths) / azimuths
    up = np.linspace(-0.5 * spread, 0.5 * spread, elevations)
    a, e = (grid.ravel() for grid in np.meshgrid(around, up, indexing="ij"))
    return LidarRays(np.stack([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)], axis=1), range)

"""Where the rays of a lidar point, and what the observation's ray coordinates are multiples of.

A robot's rays are the first coordinates of its observation. `sim` casts them in this order (a test compares the two).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


@dataclass(frozen=True)
class LidarRays:
    """directions (rays, d): unit vectors in the robot's frame; range [m]: what is observed as 1."""

    directions: Array
    range: float


def planar_rays(count: int, degrees: float, range: float) -> LidarRays:
    """Evenly over so many degrees about straight ahead, right to left."""
    spread = math.radians(degrees)
    angles = np.linspace(-0.5 * spread, 0.5 * spread, count)
    return LidarRays(np.stack([np.cos(angles), np.sin(angles)], axis=1), range)


def spherical_rays(azimuths: int, elevations: int, degrees: float, range: float) -> LidarRays:
    """Azimuths evenly over 360° from straight ahead, at each of them the elevations from low to high over `degrees`."""
    spread = math.radians(degrees)
    around = 2.0 * math.pi * np.arange(azimuths) / azimuths
    up = np.linspace(-0.5 * spread, 0.5 * spread, elevations)
    a, e = (grid.ravel() for grid in np.meshgrid(around, up, indexing="ij"))
    return LidarRays(np.stack([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)], axis=1), range)

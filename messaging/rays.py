"""Where the rays of each robot's lidar point, and what the observation's ray coordinates are multiples of.

A robot's rays are the first coordinates of its observation. `sim` casts them in this order (a test compares the two).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from messaging.robots import GROUND, QUADROTOR, RAYS, Robot

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Rays:
    """directions (rays, d): unit vectors in the robot's frame; range [m]: what is observed as 1."""

    directions: Array
    range: float


def _fan(count: int) -> Array:
    """Evenly over 180° about straight ahead, right to left."""
    angles = np.linspace(-0.5 * math.pi, 0.5 * math.pi, count)
    return np.stack([np.cos(angles), np.sin(angles)], axis=1)


def _sphere(azimuths: int, elevations: int, spread: float) -> Array:
    """Azimuths evenly over 360° from straight ahead, at each of them the elevations from low to high over `spread`."""
    around = 2.0 * math.pi * np.arange(azimuths) / azimuths
    up = np.linspace(-0.5 * spread, 0.5 * spread, elevations)
    a, e = (grid.ravel() for grid in np.meshgrid(around, up, indexing="ij"))
    return np.stack([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)], axis=1)


RAYS_OF: dict[str, Rays] = {
    GROUND.name: Rays(_fan(RAYS), 3.5),
    QUADROTOR.name: Rays(_sphere(36, 5, math.radians(60.0)), 12.0),
}


def rays_of(robot: Robot) -> Rays:
    """
    Raises:
        KeyError: nobody has said where this robot's rays point.
    """
    return RAYS_OF[robot.kind]

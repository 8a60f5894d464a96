"""Attitudes and frames, as formats have them."""

from __future__ import annotations

import math
from collections.abc import Sequence


def yaw_of(x: float, y: float, z: float, w: float) -> float:
    """rad about the vertical, from x to y, of a quaternion of any length."""
    return math.atan2(2.0 * (w * z + x * y), w * w + x * x - y * y - z * z)


def turned(q: Sequence[float], v: Sequence[float]) -> tuple[float, float, float]:
    """A vector (3,) of the body in the world, by its attitude, a quaternion (x, y, z, w)."""
    x, y, z, w = q
    n = 2.0 / (x * x + y * y + z * z + w * w)
    a, b, c = v
    return (
        a * (1 - n * (y * y + z * z)) + b * n * (x * y - z * w) + c * n * (x * z + y * w),
        a * n * (x * y + z * w) + b * (1 - n * (x * x + z * z)) + c * n * (y * z - x * w),
        a * n * (x * z - y * w) + b * n * (y * z + x * w) + c * (1 - n * (x * x + y * y)),
    )


def from_ned(north: float, east: float, down: float) -> tuple[float, float, float]:
    """The same vector in ENU."""
    return east, north, -down


def yaw_from_ned(yaw: float) -> float:
    """rad from x to y in ENU, of one from north to east."""
    return math.pi / 2.0 - yaw

"""Convert attitudes and frames of log formats."""

from __future__ import annotations

import math
from collections.abc import Sequence


def yaw_of(x: float, y: float, z: float, w: float) -> float:
    """Return the yaw in rad, from x to y, of a quaternion of any length."""
    return math.atan2(2.0 * (w * z + x * y), w * w + x * x - y * y - z * z)


def turned(q: Sequence[float], v: Sequence[float]) -> tuple[float, float, float]:
    """Rotate a vector (3,) from the body to the world by the attitude quaternion (x, y, z, w)."""
    x, y, z, w = q
    n = 2.0 / (x * x + y * y + z * z + w * w)
    a, b, c = v
    return (
        a * (1 - n * (y * y + z * z)) + b * n * (x * y - z * w) + c * n * (x * z + y * w),
        a * n * (x * y + z * w) + b * (1 - n * (x * x + z * z)) + c * n * (y * z - x * w),
        a * n * (x * z - y * w) + b * n * (y * z + x * w) + c * (1 - n * (x * x + y * y)),
    )


def from_ned(north: float, east: float, down: float) -> tuple[float, float, float]:
    """Convert a vector from NED to ENU."""
    return east, north, -down


def yaw_from_ned(yaw: float) -> float:
    """Convert a yaw from NED (north to east) to ENU (x to y), in rad."""
    return math.pi / 2.0 - yaw

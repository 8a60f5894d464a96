"""Convert frames: ENU and body forward-left-up inside the program, NED and body forward-right-down in messages."""

from __future__ import annotations

import math

from brakeline.sim.flight_controller import Vector
from brakeline.sim.flight_estimator import Quaternion, rotate
from brakeline.sim.ground_estimator import heading_of

HALF_ROOT = math.sqrt(0.5)

# The arena's origin on Earth, for GPS positions; the Earth counts as a sphere
LATITUDE, LONGITUDE, ALTITUDE = 47.397742, 8.545594, 488.0  # deg, deg, m above mean sea level
DEGREES = 180.0 / (math.pi * 6371000.0)  # of latitude in a metre


def world(vector: Vector) -> Vector:
    """Convert a vector from ENU to NED, or back: the function is its own inverse."""
    return (vector[1], vector[0], -vector[2])


def body(vector: Vector) -> Vector:
    """Convert a vector from forward-left-up to forward-right-down, or back."""
    return (vector[0], -vector[1], -vector[2])


def yaw(angle: float) -> float:
    """Convert a yaw from east, counterclockwise, to north, clockwise, or back; in (-π, π], rad."""
    return math.remainder(0.5 * math.pi - angle, math.tau)


def attitude(q: Quaternion) -> Quaternion:
    """Convert an attitude (w, x, y, z) from (ENU, forward-left-up) to (NED, forward-right-down)."""
    w, x, y, z = q
    return (HALF_ROOT * (w + z), HALF_ROOT * (x + y), HALF_ROOT * (x - y), HALF_ROOT * (w - z))


def euler(q: Quaternion) -> Vector:
    """Return roll, pitch and yaw of an attitude [rad]."""
    w, x, y, z = q
    roll = math.atan2(2.0 * (w * x + y * z), 1.0 - 2.0 * (x * x + y * y))
    pitch = math.asin(min(max(2.0 * (w * y - z * x), -1.0), 1.0))
    return (roll, pitch, heading_of(q))


def into_body(q: Quaternion, vector: Vector) -> Vector:
    """Convert a vector from the world to the axes of a body with this attitude."""
    w, x, y, z = q
    return rotate((w, -x, -y, -z), vector)


def globe(position: Vector) -> tuple[int, int, int]:
    """Return latitude and longitude [deg·1e7] and altitude [mm] of an ENU position [m], as messages carry them."""
    east, north, up = position
    latitude, longitude = LATITUDE + north * DEGREES, LONGITUDE + east * DEGREES / math.cos(math.radians(LATITUDE))
    return round(1e7 * latitude), round(1e7 * longitude), round(1e3 * (ALTITUDE + up))

"""The autopilot's edge: ENU and body forward-left-up inside, NED and body forward-right-down in messages."""

from __future__ import annotations

import math

from brakeline.sim.flight_controller import Vector
from brakeline.sim.flight_estimator import Quaternion, rotate

HALF = math.sqrt(0.5)

# Where the arena's origin lies on Earth, for those who want a position as GPS has it; metres to degrees on a sphere
LATITUDE, LONGITUDE, ALTITUDE = 47.397742, 8.545594, 488.0  # deg, deg, m above mean sea level
DEGREES = 180.0 / (math.pi * 6371000.0)  # of latitude to a metre


def world(vector: Vector) -> Vector:
    """ENU to NED, or back: the exchange is its own inverse."""
    return (vector[1], vector[0], -vector[2])


def body(vector: Vector) -> Vector:
    """Forward-left-up to forward-right-down, or back."""
    return (vector[0], -vector[1], -vector[2])


def yaw(angle: float) -> float:
    """From east, counterclockwise, to from north, clockwise, or back; in (-π, π], rad."""
    return math.remainder(0.5 * math.pi - angle, math.tau)


def attitude(q: Quaternion) -> Quaternion:
    """ENU from forward-left-up, to NED from forward-right-down."""
    w, x, y, z = q
    return (HALF * (w + z), HALF * (x + y), HALF * (x - y), HALF * (w - z))


def euler(q: Quaternion) -> Vector:
    """Roll, pitch, yaw of an attitude, rad."""
    w, x, y, z = q
    roll = math.atan2(2.0 * (w * x + y * z), 1.0 - 2.0 * (x * x + y * y))
    pitch = math.asin(min(max(2.0 * (w * y - z * x), -1.0), 1.0))
    return (roll, pitch, math.atan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z)))


def heading(q: Quaternion) -> float:
    """Where the x axis points, about the third axis, rad."""
    return euler(q)[2]


def into_body(q: Quaternion, vector: Vector) -> Vector:
    """A vector in the world, along the axes of a body with this attitude."""
    w, x, y, z = q
    return rotate((w, -x, -y, -z), vector)


def globe(position: Vector) -> tuple[float, float, float]:
    """ENU position [m] as latitude and longitude [deg] and altitude [m]."""
    east, north, up = position
    return (
        LATITUDE + north * DEGREES,
        LONGITUDE + east * DEGREES / math.cos(math.radians(LATITUDE)),
        ALTITUDE + up,
    )

"""The quantities that a flight needs from an autopilot, and the MAVLink messages that carry them.

Autopilots differ in the messages that they grant, and in those that they then send. `SOURCES` lists for each quantity
the messages that carry it, the best one first. Units and frames of the messages end here: all values are in ENU and SI
units, except an attitude, which rotates forward-right-down into NED, and a specific force, which is in
forward-right-down. `acceleration` combines these two.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from brakeline.actors.mavlink.ardupilot_dialect import mavlink
from brakeline.sim.flight_estimator import Quaternion, Vector, rotate

Array = NDArray[np.float64]

GRAVITY = 9.81  # m/s²
MILLIGRAVITY = 9.80665e-3  # m/s², the unit of some accelerometers
MOTION, ATTITUDE, FORCE, LANDED = "position and velocity", "attitude", "acceleration", "landed state"
# m of latitude in 1e-7 degrees: each simulator has its own radius of the Earth.
COPTER_UNIT, PX4_UNIT = 1e-7 * math.radians(1.0) * 6378100.0, 1e-7 * math.radians(1.0) * 6371000.0
TRUTH = "truth"  # ground truth of a simulator inside the autopilot
LOCAL, BODY = (1,), (8, 12)  # MAV_FRAME: LOCAL_NED; for a velocity also BODY_NED and BODY_FRD
UNIT_ERROR = 0.01  # of a quaternion's length
ON_GROUND, UNKNOWN = 1, 0  # MAV_LANDED_STATE

Message = Any  # pymavlink is untyped


@dataclass(frozen=True)
class MotionSample:
    """A position (3,) [m] in the autopilot's local frame and a velocity (3,) [m/s], ENU, at a time [s] of its clock."""

    time: float
    position: Array
    velocity: Array


@dataclass(frozen=True)
class GeoPosition:
    """A position on the Earth."""

    latitude: int  # 1e-7 degrees
    longitude: int  # 1e-7 degrees
    altitude: float | None  # m; None: the message has none
    metres: float  # m of latitude in 1e-7 degrees

    def since(self, first: GeoPosition) -> Array:
        """Return the displacement (3,) [m, ENU] from `first`. Its height is 0 if an altitude is unknown."""
        cos_latitude = math.cos(math.radians(1e-7 * first.latitude))
        up = 0.0 if self.altitude is None or first.altitude is None else self.altitude - first.altitude
        east, north = self.longitude - first.longitude, self.latitude - first.latitude
        return np.array([self.metres * cos_latitude * east, self.metres * north, up])


@dataclass(frozen=True)
class TelemetrySource:
    """A message that carries a quantity."""

    message: str
    read: Callable[[Message], Any]  # returns the quantity; None if this message does not contain it
    kinds: tuple[str, ...] = ("px4", "ardupilot")  # the autopilots whose message has this meaning


def read_source(source: TelemetrySource, message: Message) -> Any:
    """Return the quantity in a message; None if it is missing, or a number in it is not finite."""
    try:
        value = source.read(message)
    except (ValueError, OverflowError):  # an infinite angle has no sine
        return None
    if isinstance(value, MotionSample):
        numbers = (value.time, *value.position.tolist(), *value.velocity.tolist())
        finite = all(map(math.isfinite, numbers))
    else:
        finite = not isinstance(value, tuple) or all(map(math.isfinite, value))
    return value if finite else None


def enu_of(ned: Vector) -> Array:
    """Convert a vector from NED to ENU."""
    north, east, down = ned
    return np.array([east, north, -down])


def acceleration(attitude: Quaternion, force: Vector) -> Array:
    """Return the acceleration (3,) [m/s², ENU] without gravity, from an accelerometer's specific force."""
    north, east, down = rotate(attitude, force)
    return np.array([east, north, -down - GRAVITY])


def resampled(times: Sequence[float], positions: Array, at: NDArray[np.floating[Any]]) -> Array:
    """Return positions (S, 3) at the times `at` (S,), interpolated between `positions` (n, 3) at `times` (n,)."""
    return np.column_stack([np.interp(at, times, positions[:, axis]) for axis in range(3)])


def _position(m: Message) -> MotionSample:
    return MotionSample(1e-3 * m.time_boot_ms, enu_of((m.x, m.y, m.z)), enu_of((m.vx, m.vy, m.vz)))


def _is_unit(attitude: Sequence[float]) -> bool:
    """Return whether a quaternion is a rotation. Zeros stand for an unknown one, but would turn nothing."""
    return abs(math.hypot(*attitude) - 1.0) <= UNIT_ERROR


def _odometry(m: Message) -> MotionSample | None:
    """Read a pose in the local frame; the velocity may be in the body frame."""
    velocity = (m.vx, m.vy, m.vz)
    if m.frame_id not in LOCAL or m.child_frame_id not in LOCAL + BODY:
        return None
    if m.child_frame_id in BODY:
        if not _is_unit(m.q):
            return None
        velocity = rotate(tuple(m.q), velocity)
    return MotionSample(1e-6 * m.time_usec, enu_of((m.x, m.y, m.z)), enu_of(velocity))


def _attitude(q: Quaternion) -> Quaternion | None:
    """Return a quaternion; None: it is no rotation."""
    return q if _is_unit(q) else None


def _euler(m: Message) -> Quaternion:
    """Convert Euler angles: yaw first, then pitch, then roll."""
    cr, sr = math.cos(0.5 * m.roll), math.sin(0.5 * m.roll)
    cp, sp = math.cos(0.5 * m.pitch), math.sin(0.5 * m.pitch)
    cy, sy = math.cos(0.5 * m.yaw), math.sin(0.5 * m.yaw)
    return (
        cr * cp * cy + sr * sp * sy,
        sr * cp * cy - cr * sp * sy,
        cr * sp * cy + sr * cp * sy,
        cr * cp * sy - sr * sp * cy,
    )


def _milligravities(m: Message) -> Vector:
    return (MILLIGRAVITY * m.xacc, MILLIGRAVITY * m.yacc, MILLIGRAVITY * m.zacc)


SOURCES: dict[str, tuple[TelemetrySource, ...]] = {
    ATTITUDE: (
        TelemetrySource("ATTITUDE_QUATERNION", lambda m: _attitude((m.q1, m.q2, m.q3, m.q4))),
        TelemetrySource("ODOMETRY", lambda m: _attitude(tuple(m.q)) if m.frame_id in LOCAL else None),
        TelemetrySource("ATTITUDE", _euler),
    ),
    FORCE: (
        TelemetrySource("HIGHRES_IMU", lambda m: (m.xacc, m.yacc, m.zacc)),
        TelemetrySource("SCALED_IMU", _milligravities),
        # The standard says that its values are raw; ArduPilot sends the units of SCALED_IMU.
        TelemetrySource("RAW_IMU", _milligravities, ("ardupilot",)),
        TelemetrySource("SCALED_IMU2", _milligravities),
    ),
    LANDED: (
        TelemetrySource(
            "EXTENDED_SYS_STATE", lambda m: None if m.landed_state == UNKNOWN else m.landed_state != ON_GROUND
        ),
    ),
    MOTION: (TelemetrySource("LOCAL_POSITION_NED", _position), TelemetrySource("ODOMETRY", _odometry)),
    TRUTH: (
        TelemetrySource("SIMSTATE", lambda m: GeoPosition(m.lat, m.lng, None, COPTER_UNIT), ("ardupilot",)),
        TelemetrySource("HIL_STATE_QUATERNION", lambda m: GeoPosition(m.lat, m.lon, 1e-3 * m.alt, PX4_UNIT), ("px4",)),
    ),
}
IN_FLIGHT = (MOTION, ATTITUDE, FORCE)  # telemetry counts as lost if one of these stops

# EKF_STATUS_REPORT (ArduPilot) and ESTIMATOR_STATUS (PX4) have the same flags.
ESTIMATED = {
    "attitude": 1,
    "horizontal velocity": 2,
    "vertical velocity": 4,
    "horizontal position": 8 | 16,
    "height": 32,
}
CONSTANT_POSITION = 128  # flag: the estimator only assumes that the vehicle stands still
ESTIMATORS = ("EKF_STATUS_REPORT", "ESTIMATOR_STATUS")


def unknown_quantities(flags: int) -> list[str]:
    """Return the names of the quantities that the estimator does not know yet, from its flags."""
    unknown = [name for name, bits in ESTIMATED.items() if not flags & bits]
    return unknown + ["anything except that the vehicle stands still"] * bool(flags & CONSTANT_POSITION)


PX4_MODES = {1: "MANUAL", 2: "ALTCTL", 3: "POSCTL", 5: "ACRO", 6: "OFFBOARD", 7: "STABILIZED"}
PX4_AUTO = {1: "READY", 2: "TAKEOFF", 3: "HOLD", 4: "MISSION", 5: "RETURN", 6: "LAND", 8: "FOLLOW", 9: "PRECLAND"}


def mode_name(kind: str, custom: int) -> str:
    """Return the name of the custom mode in a HEARTBEAT."""
    if kind == "ardupilot":
        known = mavlink.enums["COPTER_MODE"].get(custom)
        return f"mode {custom}" if known is None else known.name.removeprefix("COPTER_MODE_")
    main, sub = custom >> 16 & 0xFF, custom >> 24 & 0xFF
    names, number = (PX4_AUTO, sub) if main == 4 else (PX4_MODES, main)
    return names.get(number, f"mode {main}.{sub}")

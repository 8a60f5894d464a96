"""What an autopilot can tell about its vehicle, and by which messages: their units and frames end here.

Autopilots differ in what they grant, and in what then comes: a list for each thing needed, the best first. What goes
out is ENU and SI, but for two that only make sense together: an attitude turns forward-right-down into NED, a force is
felt along forward-right-down.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Quaternion = tuple[float, float, float, float]  # w, x, y, z
Triple = tuple[float, float, float]

GRAVITY = 9.81  # m/s²
MILLIGRAVITY = 9.80665e-3  # m/s², the unit of some accelerometers
MOTION, ATTITUDE, FORCE, LANDED = "position and velocity", "attitude", "acceleration", "landed state"
COPTER_EARTH, PX4_EARTH = 6378100.0, 6371000.0  # m, the radius that each lays its map with
TRUTH = "truth"  # of a simulator inside the autopilot
LOCAL, BODY = (1,), (8, 12)  # MAV_FRAME: LOCAL_NED; BODY_NED and BODY_FRD of a velocity
ON_GROUND, UNKNOWN = 1, 0  # MAV_LANDED_STATE

Message = Any  # pymavlink is untyped


@dataclass(frozen=True)
class MotionSample:
    """time [s] by the autopilot's clock, position [m] in its local frame, velocity [m/s]; (3,) each, ENU."""

    time: float
    position: Array
    velocity: Array


@dataclass(frozen=True)
class GeoPosition:
    """Latitude and longitude [1e-7 degrees], altitude [m] if it is told, and how many m of latitude one of these is:
    each simulator has an Earth of its own."""

    latitude: int
    longitude: int
    altitude: float | None
    metres: float

    def since(self, first: GeoPosition) -> Array:
        """(3,) m, ENU, from another; a height that is not told is 0."""
        narrow = math.cos(math.radians(1e-7 * first.latitude))
        up = 0.0 if self.altitude is None or first.altitude is None else self.altitude - first.altitude
        east, north = self.longitude - first.longitude, self.latitude - first.latitude
        return np.array([self.metres * narrow * east, self.metres * north, up])


@dataclass(frozen=True)
class TelemetrySource:
    """A message that tells something; `read` gives None when it does not this time."""

    message: str
    read: Callable[[Message], Any]
    kinds: tuple[str, ...] = ("px4", "ardupilot")  # whose it is to be understood so


def told(source: TelemetrySource, message: Message) -> Any:
    """What a message says; None: nothing, for what is no number is not told."""
    try:
        said = source.read(message)
    except (ValueError, OverflowError):  # of an infinite angle there is no sine
        return None
    if isinstance(said, MotionSample):
        numbers = math.isfinite(said.time) and bool(np.isfinite([said.position, said.velocity]).all())
    else:
        numbers = not isinstance(said, tuple) or all(map(math.isfinite, said))
    return said if numbers else None


def turned(q: Quaternion, vector: Triple) -> Triple:
    """A vector in the frame that the attitude turns into."""
    w, x, y, z = q
    a, b, c = vector
    tx, ty, tz = 2.0 * (y * c - z * b), 2.0 * (z * a - x * c), 2.0 * (x * b - y * a)
    return (a + w * tx + y * tz - z * ty, b + w * ty + z * tx - x * tz, c + w * tz + x * ty - y * tx)


def world(ned: Triple) -> Array:
    """NED to ENU."""
    north, east, down = ned
    return np.array([east, north, -down])


def acceleration(attitude: Quaternion, force: Triple) -> Array:
    """(3,) m/s², ENU: what an accelerometer feels, turned into the world, gravity taken out."""
    north, east, down = turned(attitude, force)
    return np.array([east, north, -down - GRAVITY])


def _position(m: Message) -> MotionSample:
    return MotionSample(1e-3 * m.time_boot_ms, world((m.x, m.y, m.z)), world((m.vx, m.vy, m.vz)))


def _odometry(m: Message) -> MotionSample | None:
    """Only in the local frame; its velocity may be along the body."""
    velocity = (m.vx, m.vy, m.vz)
    if m.frame_id not in LOCAL or m.child_frame_id not in LOCAL + BODY:
        return None
    if m.child_frame_id in BODY:
        velocity = turned(tuple(m.q), velocity)
    return MotionSample(1e-6 * m.time_usec, world((m.x, m.y, m.z)), world(velocity))


def _quaternion(m: Message) -> Quaternion:
    return (m.q1, m.q2, m.q3, m.q4)


def _odometry_attitude(m: Message) -> Quaternion | None:
    return tuple(m.q) if m.frame_id in LOCAL else None


def _euler(m: Message) -> Quaternion:
    """Yaw, then pitch, then roll."""
    cr, sr = math.cos(0.5 * m.roll), math.sin(0.5 * m.roll)
    cp, sp = math.cos(0.5 * m.pitch), math.sin(0.5 * m.pitch)
    cy, sy = math.cos(0.5 * m.yaw), math.sin(0.5 * m.yaw)
    return (
        cr * cp * cy + sr * sp * sy,
        sr * cp * cy - cr * sp * sy,
        cr * sp * cy + sr * cp * sy,
        cr * cp * sy - sr * sp * cy,
    )


def _metric(m: Message) -> Triple:
    return (m.xacc, m.yacc, m.zacc)


def _milligravities(m: Message) -> Triple:
    return (MILLIGRAVITY * m.xacc, MILLIGRAVITY * m.yacc, MILLIGRAVITY * m.zacc)


def _airborne(m: Message) -> bool | None:
    return None if m.landed_state == UNKNOWN else m.landed_state != ON_GROUND


def _simstate(m: Message) -> GeoPosition:
    return GeoPosition(m.lat, m.lng, None, 1e-7 * math.radians(1.0) * COPTER_EARTH)


def _hil_state(m: Message) -> GeoPosition:
    return GeoPosition(m.lat, m.lon, 1e-3 * m.alt, 1e-7 * math.radians(1.0) * PX4_EARTH)


SOURCES: dict[str, tuple[TelemetrySource, ...]] = {
    ATTITUDE: (
        TelemetrySource("ATTITUDE_QUATERNION", _quaternion),
        TelemetrySource("ODOMETRY", _odometry_attitude),
        TelemetrySource("ATTITUDE", _euler),
    ),
    FORCE: (
        TelemetrySource("HIGHRES_IMU", _metric),
        TelemetrySource("SCALED_IMU", _milligravities),
        TelemetrySource("RAW_IMU", _milligravities, ("ardupilot",)),  # raw by the book; there it is what SCALED_IMU has
        TelemetrySource("SCALED_IMU2", _milligravities),
    ),
    LANDED: (TelemetrySource("EXTENDED_SYS_STATE", _airborne),),
    MOTION: (TelemetrySource("LOCAL_POSITION_NED", _position), TelemetrySource("ODOMETRY", _odometry)),
    TRUTH: (
        TelemetrySource("SIMSTATE", _simstate, ("ardupilot",)),
        TelemetrySource("HIL_STATE_QUATERNION", _hil_state, ("px4",)),
    ),
}
IN_FLIGHT = (MOTION, ATTITUDE, FORCE)  # what is lost when it stops coming

# EKF_STATUS_REPORT (ArduPilot) and ESTIMATOR_STATUS (PX4) have the same flags.
ESTIMATED = {
    "attitude": 1,
    "horizontal velocity": 2,
    "vertical velocity": 4,
    "horizontal position": 8 | 16,
    "height": 32,
}
CONSTANT_POSITION = 128  # it only assumes that it stands still
ESTIMATORS = ("EKF_STATUS_REPORT", "ESTIMATOR_STATUS")


def missing(flags: int) -> list[str]:
    """What the estimator does not know yet, by its flags."""
    lacking = [name for name, bits in ESTIMATED.items() if not flags & bits]
    return lacking + ["anything but that it stands still"] * bool(flags & CONSTANT_POSITION)


# --- modes ----------------------------------------------------------------------------------------------------------

COPTER_MODES = {
    0: "STABILIZE", 1: "ACRO", 2: "ALT_HOLD", 3: "AUTO", 4: "GUIDED", 5: "LOITER", 6: "RTL", 7: "CIRCLE", 9: "LAND",
    11: "DRIFT", 13: "SPORT", 14: "FLIP", 15: "AUTOTUNE", 16: "POSHOLD", 17: "BRAKE", 18: "THROW", 19: "AVOID_ADSB",
    20: "GUIDED_NOGPS", 21: "SMART_RTL",
}  # fmt: skip
PX4_MODES = {1: "MANUAL", 2: "ALTCTL", 3: "POSCTL", 5: "ACRO", 6: "OFFBOARD", 7: "STABILIZED"}
PX4_AUTO = {1: "READY", 2: "TAKEOFF", 3: "HOLD", 4: "MISSION", 5: "RETURN", 6: "LAND", 8: "FOLLOW", 9: "PRECLAND"}


def mode_name(kind: str, custom: int) -> str:
    """What people call a HEARTBEAT's custom mode."""
    if kind == "ardupilot":
        return COPTER_MODES.get(custom, f"mode {custom}")
    main, sub = custom >> 16 & 0xFF, custom >> 24 & 0xFF
    names, number = (PX4_AUTO, sub) if main == 4 else (PX4_MODES, main)
    return names.get(number, f"mode {main}.{sub}")

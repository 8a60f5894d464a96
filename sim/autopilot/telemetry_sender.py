"""Build the telemetry messages of the autopilot, and schedule their streams."""

from __future__ import annotations

import math
from typing import Any

from brakeline.sim.autopilot import ned_frames
from brakeline.sim.autopilot.common_dialect import mavlink
from brakeline.sim.autopilot.flight_modes import FlightStateMachine
from brakeline.sim.flight_estimator import Estimate
from brakeline.sim.ground_estimator import heading_of

UNKNOWN = 65535  # the value of a field without a measurement
SENSORS = (
    mavlink.MAV_SYS_STATUS_SENSOR_3D_GYRO
    | mavlink.MAV_SYS_STATUS_SENSOR_3D_ACCEL
    | mavlink.MAV_SYS_STATUS_SENSOR_3D_MAG
    | mavlink.MAV_SYS_STATUS_SENSOR_ABSOLUTE_PRESSURE
    | mavlink.MAV_SYS_STATUS_SENSOR_GPS
    | mavlink.MAV_SYS_STATUS_AHRS
    | mavlink.MAV_SYS_STATUS_PREARM_CHECK
)
CAPABILITIES = (
    mavlink.MAV_PROTOCOL_CAPABILITY_MAVLINK2
    | mavlink.MAV_PROTOCOL_CAPABILITY_COMMAND_INT
    | mavlink.MAV_PROTOCOL_CAPABILITY_SET_POSITION_TARGET_LOCAL_NED
)
MILLIVOLTS, CHARGE = 16200, 100  # mV, %; the simulation has no battery
MILLIGRAVITY = 9.80665e-3  # m/s²
IMU_UPDATED = 0x3F  # bits of HIGHRES_IMU: accelerometer and gyro
NO_COVARIANCE = [math.nan, *[0.0] * 20]
Message = Any  # pymavlink is untyped


class TelemetryBuilder:
    """Builds messages about one vehicle. `MESSAGES` has the message ids of its methods."""

    def __init__(self, flight: FlightStateMachine) -> None:
        self._flight = flight
        self._estimate: tuple[float, Estimate] | None = None  # with its time

    @property
    def estimate(self) -> Estimate:
        """The present estimate, which all messages of one moment share."""
        now = self._flight.time
        if self._estimate is None or self._estimate[0] != now:
            self._estimate = (now, self._flight.vehicle.estimate())
        return self._estimate[1]

    def build(self, kind: int) -> Message:
        """Return the message with this id, one of `MESSAGES`."""
        message: Message = getattr(self, MESSAGES[kind])()
        return message

    def heading(self) -> float:
        """Return the heading, rad from north."""
        return ned_frames.yaw(heading_of(self.estimate.attitude))

    def _milliseconds(self) -> int:
        return round(1e3 * self._flight.time)

    def _microseconds(self) -> int:
        return round(1e6 * self._flight.time)

    def _motion(self) -> tuple[tuple[float, ...], tuple[float, ...]]:
        """Return the estimated position [m] and velocity [m/s] in NED."""
        position, velocity = self._flight.vehicle.position_and_velocity()
        return ned_frames.world(position), ned_frames.world(velocity)

    def _globe(self) -> tuple[int, int, int]:
        """Return the estimated latitude and longitude [deg·1e7] and altitude [mm]."""
        return ned_frames.globe(self._flight.vehicle.position_and_velocity()[0])

    def _imu(self) -> tuple[tuple[float, ...], tuple[float, ...]]:
        """Return the specific force [m/s²] and the turn rates [rad/s], forward-right-down."""
        return ned_frames.body(self.estimate.specific_force), ned_frames.body(self.estimate.rates)

    def sys_status(self) -> Message:
        return mavlink.MAVLink_sys_status_message(
            SENSORS, SENSORS, SENSORS, 200, MILLIVOLTS, -1, CHARGE, 0, 0, 0, 0, 0, 0
        )

    def extended_sys_state(self) -> Message:
        return mavlink.MAVLink_extended_sys_state_message(0, self._flight.landed)

    def attitude(self) -> Message:
        angles = ned_frames.euler(ned_frames.attitude(self.estimate.attitude))
        return mavlink.MAVLink_attitude_message(self._milliseconds(), *angles, *ned_frames.body(self.estimate.rates))

    def attitude_quaternion(self) -> Message:
        q, rates = ned_frames.attitude(self.estimate.attitude), ned_frames.body(self.estimate.rates)
        return mavlink.MAVLink_attitude_quaternion_message(self._milliseconds(), *q, *rates)

    def local_position_ned(self) -> Message:
        position, velocity = self._motion()
        return mavlink.MAVLink_local_position_ned_message(self._milliseconds(), *position, *velocity)

    def global_position_int(self) -> Message:
        position, velocity = self._motion()
        above_home = -position[2] - self._flight.home[2]
        heading = round(100.0 * (math.degrees(self.heading()) % 360.0)) % 36000
        speeds = (round(100.0 * v) for v in velocity)
        return mavlink.MAVLink_global_position_int_message(
            self._milliseconds(), *self._globe(), round(1e3 * above_home), *speeds, heading
        )

    def gps_raw_int(self) -> Message:
        speed = round(100.0 * math.hypot(*self._motion()[1][:2]))
        return mavlink.MAVLink_gps_raw_int_message(
            self._microseconds(), mavlink.GPS_FIX_TYPE_3D_FIX, *self._globe(), 70, 80, speed, UNKNOWN, 14
        )

    def highres_imu(self) -> Message:
        force, rates = self._imu()
        return mavlink.MAVLink_highres_imu_message(self._microseconds(), *force, *rates, *[0.0] * 7, IMU_UPDATED)

    def scaled_imu(self) -> Message:
        """Return SCALED_IMU: thousandths of g and of rad/s."""
        force, rates = self._imu()
        scaled = (*(round(value / MILLIGRAVITY) for value in force), *(round(1e3 * rate) for rate in rates))
        return mavlink.MAVLink_scaled_imu_message(self._milliseconds(), *scaled, 0, 0, 0)

    def odometry(self) -> Message:
        """Return ODOMETRY as PX4 sends it: position in NED, velocity along the body's axes."""
        position, velocity = self._motion()
        q = ned_frames.attitude(self.estimate.attitude)
        along = ned_frames.into_body(q, (velocity[0], velocity[1], velocity[2]))
        return mavlink.MAVLink_odometry_message(
            self._microseconds(), mavlink.MAV_FRAME_LOCAL_NED, mavlink.MAV_FRAME_BODY_FRD, *position, q,
            *along, *ned_frames.body(self.estimate.rates), NO_COVARIANCE, NO_COVARIANCE,
        )  # fmt: skip

    def vfr_hud(self) -> Message:
        position, velocity = self._motion()
        heading = round(math.degrees(self.heading())) % 360
        speed = math.hypot(*velocity[:2])
        throttle = 50 if self._flight.vehicle.flying else 0
        altitude = ned_frames.ALTITUDE - position[2]
        return mavlink.MAVLink_vfr_hud_message(speed, speed, heading, throttle, altitude, -velocity[2])

    def home_position(self) -> Message:
        home = self._flight.home
        return mavlink.MAVLink_home_position_message(
            *ned_frames.globe(home), *ned_frames.world(home), [1.0, 0.0, 0.0, 0.0], 0.0, 0.0, 0.0
        )

    def autopilot_version(self) -> Message:
        none = [0] * 8
        return mavlink.MAVLink_autopilot_version_message(CAPABILITIES, 1 << 24, 0, 0, 0, none, none, none, 0, 0, 1)


MESSAGES = {
    getattr(mavlink, f"MAVLINK_MSG_ID_{name.upper()}"): name
    for name in (
        "sys_status", "extended_sys_state", "attitude", "attitude_quaternion", "local_position_ned",
        "global_position_int", "gps_raw_int", "highres_imu", "scaled_imu", "odometry", "vfr_hud", "home_position",
        "autopilot_version",
    )
}  # fmt: skip


class StreamSchedule:
    """Schedules message streams. Times are multiples of the autopilot's tick; rounding of half a tick is tolerated."""

    def __init__(self, tick: float) -> None:
        self._slack = 0.5 * tick
        self._intervals: dict[int, float] = {}  # s, by message id
        self._due: dict[int, float] = {}  # s, time of the next message

    def set(self, kind: int, interval: float, now: float) -> None:
        """Send a message every `interval` seconds from now on; 0 or less stops it."""
        self._intervals.pop(kind, None)
        if interval > 0.0:
            self._intervals[kind], self._due[kind] = interval, now + interval

    def interval(self, kind: int) -> float:
        """Return the interval of a message [s]; 0 if it is not sent."""
        return self._intervals.get(kind, 0.0)

    def due(self, now: float) -> list[int]:
        """Return the messages to send now."""
        kinds = [kind for kind in self._intervals if now >= self._due[kind] - self._slack]
        for kind in kinds:
            self._due[kind] = max(self._due[kind] + self._intervals[kind], now)
        return kinds

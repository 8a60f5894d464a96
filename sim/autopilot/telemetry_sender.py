"""Build the telemetry messages of the autopilot, and schedule their streams."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from brakeline.sim.autopilot import ned_frames
from brakeline.sim.autopilot.common_dialect import mavlink
from brakeline.sim.autopilot.flight_modes import FlightStateMachine, LandedState
from brakeline.sim.flight_estimator import Estimate
from brakeline.sim.ground_estimator import heading_of
from brakeline.sim.lidar import Lidar

BINS = 72  # of OBSTACLE_DISTANCE, clockwise from straight ahead
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
VOLTAGE, CHARGE = 16.2, 100  # V, %; the simulation has no battery
MILLIGRAVITY = 9.80665e-3  # m/s²
NO_COVARIANCE = [math.nan, *[0.0] * 20]
LANDED_STATES = {
    LandedState.ON_GROUND: mavlink.MAV_LANDED_STATE_ON_GROUND,
    LandedState.TAKING_OFF: mavlink.MAV_LANDED_STATE_TAKEOFF,
    LandedState.IN_AIR: mavlink.MAV_LANDED_STATE_IN_AIR,
    LandedState.LANDING: mavlink.MAV_LANDED_STATE_LANDING,
}
Message = Any  # pymavlink is untyped


def obstacle_bins(ranges: NDArray[np.float64], directions: NDArray[np.float64], farthest: float) -> list[int]:
    """Return the distances [cm] in `BINS` sectors around the vehicle.

    The distance of a sector is the least horizontal part of its beams. A sector without a beam takes the lesser of its
    neighbours. `farthest` + 1 cm means that a sector is free.

    Args:
        ranges: (R,) m.
        directions: (R, 3) unit vectors, forward-left-up.
        farthest: m.
    """
    top = round(100.0 * farthest)
    sector = np.round(-np.arctan2(directions[:, 1], directions[:, 0]) * (BINS / math.tau)).astype(int) % BINS
    level = np.hypot(directions[:, 0], directions[:, 1])
    distances = np.where(ranges < farthest, np.floor(100.0 * ranges * level), top + 1)
    bins = np.full(BINS, UNKNOWN)
    np.minimum.at(bins, sector, distances.astype(int))
    between = np.minimum(np.roll(bins, 1), np.roll(bins, -1))
    return [int(value) for value in np.where(bins == UNKNOWN, between, bins)]


class TelemetryBuilder:
    """Builds messages about one vehicle; `BUILDERS` lists them by message id."""

    def __init__(self, flight: FlightStateMachine, lidar: Lidar | None) -> None:
        self._flight, self._lidar = flight, lidar
        self._estimate: tuple[float, Estimate] | None = None  # with its time

    @property
    def estimate(self) -> Estimate:
        """The present estimate, which all messages of one moment share."""
        now = self._flight.time
        if self._estimate is None or self._estimate[0] != now:
            self._estimate = (now, self._flight.vehicle.estimate())
        return self._estimate[1]

    @property
    def milliseconds(self) -> int:
        return round(1e3 * self._flight.time)

    @property
    def microseconds(self) -> int:
        return round(1e6 * self._flight.time)

    def build(self, kind: int) -> Message | None:
        """Return the message with this id; None if the vehicle has no such sensor."""
        return BUILDERS[kind](self)

    def sys_status(self) -> Message:
        return mavlink.MAVLink_sys_status_message(
            SENSORS, SENSORS, SENSORS, 200, round(1e3 * VOLTAGE), -1, CHARGE, 0, 0, 0, 0, 0, 0
        )

    def battery_status(self) -> Message:
        cells = [round(1e3 * VOLTAGE / 4.0)] * 4 + [UNKNOWN] * 6
        return mavlink.MAVLink_battery_status_message(0, 0, 3, 32767, cells, -1, -1, -1, CHARGE)

    def extended_sys_state(self) -> Message:
        return mavlink.MAVLink_extended_sys_state_message(0, LANDED_STATES[self._flight.landed])

    def attitude(self) -> Message:
        roll, pitch, yaw = ned_frames.euler(ned_frames.attitude(self.estimate.attitude))
        return mavlink.MAVLink_attitude_message(
            self.milliseconds, roll, pitch, yaw, *ned_frames.body(self.estimate.rates)
        )

    def attitude_quaternion(self) -> Message:
        q, rates = ned_frames.attitude(self.estimate.attitude), ned_frames.body(self.estimate.rates)
        return mavlink.MAVLink_attitude_quaternion_message(self.milliseconds, *q, *rates)

    def local_position_ned(self) -> Message:
        position, velocity = self._flight.vehicle.position_and_velocity()
        return mavlink.MAVLink_local_position_ned_message(
            self.milliseconds, *ned_frames.world(position), *ned_frames.world(velocity)
        )

    def global_position_int(self) -> Message:
        position, velocity = self._flight.vehicle.position_and_velocity()
        latitude, longitude, altitude = ned_frames.globe(position)
        vx, vy, vz = (round(100.0 * v) for v in ned_frames.world(velocity))
        heading = math.degrees(ned_frames.yaw(heading_of(self.estimate.attitude))) % 360.0
        above_home = position[2] - self._flight.home[2]
        return mavlink.MAVLink_global_position_int_message(
            self.milliseconds, round(1e7 * latitude), round(1e7 * longitude), round(1e3 * altitude),
            round(1e3 * above_home), vx, vy, vz, round(100.0 * heading) % 36000,
        )  # fmt: skip

    def gps_raw_int(self) -> Message:
        position, velocity = self._flight.vehicle.position_and_velocity()
        latitude, longitude, altitude = ned_frames.globe(position)
        speed = round(100.0 * math.hypot(velocity[0], velocity[1]))
        return mavlink.MAVLink_gps_raw_int_message(
            self.microseconds, mavlink.GPS_FIX_TYPE_3D_FIX, round(1e7 * latitude), round(1e7 * longitude),
            round(1e3 * altitude), 70, 80, speed, UNKNOWN, 14,
        )  # fmt: skip

    def highres_imu(self) -> Message:
        acceleration, rates = ned_frames.body(self.estimate.specific_force), ned_frames.body(self.estimate.rates)
        updated = 0x3F  # accelerometer and gyro
        return mavlink.MAVLink_highres_imu_message(
            self.microseconds, *acceleration, *rates, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, updated
        )

    def scaled_imu(self) -> Message:
        """Return SCALED_IMU: thousandths of g and of rad/s."""
        acceleration, rates = ned_frames.body(self.estimate.specific_force), ned_frames.body(self.estimate.rates)
        force, turning = (round(value / MILLIGRAVITY) for value in acceleration), (round(1e3 * rate) for rate in rates)
        return mavlink.MAVLink_scaled_imu_message(self.milliseconds, *force, *turning, 0, 0, 0)

    def odometry(self) -> Message:
        """Return ODOMETRY as PX4 sends it: position in NED, velocity along the body's axes."""
        position, velocity = self._flight.vehicle.position_and_velocity()
        q = ned_frames.attitude(self.estimate.attitude)
        along = ned_frames.into_body(q, ned_frames.world(velocity))
        return mavlink.MAVLink_odometry_message(
            self.microseconds, mavlink.MAV_FRAME_LOCAL_NED, mavlink.MAV_FRAME_BODY_FRD, *ned_frames.world(position), q,
            *along, *ned_frames.body(self.estimate.rates), NO_COVARIANCE, NO_COVARIANCE,
        )  # fmt: skip

    def vfr_hud(self) -> Message:
        position, velocity = self._flight.vehicle.position_and_velocity()
        heading = round(math.degrees(ned_frames.yaw(heading_of(self.estimate.attitude)))) % 360
        speed = math.hypot(velocity[0], velocity[1])
        throttle = 50 if self._flight.vehicle.flying else 0
        return mavlink.MAVLink_vfr_hud_message(
            speed, speed, heading, throttle, ned_frames.ALTITUDE + position[2], velocity[2]
        )

    def home_position(self) -> Message:
        latitude, longitude, altitude = ned_frames.globe(self._flight.home)
        return mavlink.MAVLink_home_position_message(
            round(1e7 * latitude), round(1e7 * longitude), round(1e3 * altitude), *ned_frames.world(self._flight.home),
            [1.0, 0.0, 0.0, 0.0], 0.0, 0.0, 0.0,
        )  # fmt: skip

    def obstacle_distance(self) -> Message | None:
        if self._lidar is None:
            return None
        rays = self._lidar.rays
        ranges = self._lidar.ranges(self._flight.vehicle.state()[:3], heading_of(self.estimate.attitude))
        bins = obstacle_bins(ranges, rays.directions, rays.range)
        return mavlink.MAVLink_obstacle_distance_message(
            self.microseconds, mavlink.MAV_DISTANCE_SENSOR_LASER, bins, 0, 20, round(100.0 * rays.range),
            360.0 / BINS, 0.0, mavlink.MAV_FRAME_BODY_FRD,
        )  # fmt: skip

    def autopilot_version(self) -> Message:
        capabilities = (
            mavlink.MAV_PROTOCOL_CAPABILITY_MAVLINK2
            | mavlink.MAV_PROTOCOL_CAPABILITY_COMMAND_INT
            | mavlink.MAV_PROTOCOL_CAPABILITY_SET_POSITION_TARGET_LOCAL_NED
        )
        none = [0] * 8
        return mavlink.MAVLink_autopilot_version_message(capabilities, 1 << 24, 0, 0, 0, none, none, none, 0, 0, 1)


BUILDERS: dict[int, Callable[[TelemetryBuilder], Message | None]] = {
    mavlink.MAVLINK_MSG_ID_SYS_STATUS: TelemetryBuilder.sys_status,
    mavlink.MAVLINK_MSG_ID_BATTERY_STATUS: TelemetryBuilder.battery_status,
    mavlink.MAVLINK_MSG_ID_EXTENDED_SYS_STATE: TelemetryBuilder.extended_sys_state,
    mavlink.MAVLINK_MSG_ID_ATTITUDE: TelemetryBuilder.attitude,
    mavlink.MAVLINK_MSG_ID_ATTITUDE_QUATERNION: TelemetryBuilder.attitude_quaternion,
    mavlink.MAVLINK_MSG_ID_LOCAL_POSITION_NED: TelemetryBuilder.local_position_ned,
    mavlink.MAVLINK_MSG_ID_GLOBAL_POSITION_INT: TelemetryBuilder.global_position_int,
    mavlink.MAVLINK_MSG_ID_GPS_RAW_INT: TelemetryBuilder.gps_raw_int,
    mavlink.MAVLINK_MSG_ID_HIGHRES_IMU: TelemetryBuilder.highres_imu,
    mavlink.MAVLINK_MSG_ID_SCALED_IMU: TelemetryBuilder.scaled_imu,
    mavlink.MAVLINK_MSG_ID_ODOMETRY: TelemetryBuilder.odometry,
    mavlink.MAVLINK_MSG_ID_VFR_HUD: TelemetryBuilder.vfr_hud,
    mavlink.MAVLINK_MSG_ID_HOME_POSITION: TelemetryBuilder.home_position,
    mavlink.MAVLINK_MSG_ID_OBSTACLE_DISTANCE: TelemetryBuilder.obstacle_distance,
    mavlink.MAVLINK_MSG_ID_AUTOPILOT_VERSION: TelemetryBuilder.autopilot_version,
}


@dataclass
class Stream:
    """The stream of one message."""

    interval: float  # s
    due: float  # s, time of the next message


class StreamSchedule:
    """Schedules message streams. Times are multiples of the autopilot's tick; rounding of half a tick is tolerated."""

    def __init__(self, tick: float) -> None:
        self._slack = 0.5 * tick
        self._streams: dict[int, Stream] = {}

    def set(self, kind: int, interval: float, now: float) -> None:
        """Send a message every `interval` seconds from now on; 0 or less stops it."""
        self._streams.pop(kind, None)
        if interval > 0.0:
            self._streams[kind] = Stream(interval, now + interval)

    def interval(self, kind: int) -> float:
        """Return the interval of a message [s]; 0 if it is not sent."""
        stream = self._streams.get(kind)
        return 0.0 if stream is None else stream.interval

    def due(self, now: float) -> list[int]:
        """Return the messages to send now."""
        kinds = []
        for kind, stream in self._streams.items():
            if now >= stream.due - self._slack:
                stream.due = max(stream.due + stream.interval, now)
                kinds.append(kind)
        return kinds

"""A motion capture system: sends position and velocity to a PX4 with its own simulator, as cameras would."""

from __future__ import annotations

import math
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np

from benchmarks.timing import repeated
from brakeline.messaging.byte_links import Link, open_link
from brakeline.sim.autopilot.common_dialect import mavlink

CAMERAS_ID = 250  # MAVLink system id
MEASUREMENT_PERIOD = 0.02  # s
READ_PERIOD = 0.002  # s between two reads of the link
ERROR, SPEED_ERROR = 0.01, 0.02  # m, m/s: σ of each axis; the simulator rounds to 1 cm and 1 cm/s besides
UNKNOWN = [math.nan, *[0.0] * 20]  # a covariance that is not known
DEGREE = math.radians(1.0) * 6_371_000.0  # m of a degree of latitude in that simulator

# The estimator takes position and velocity from the cameras, not from GPS. These velocities are so good that the
# controller can be stiffer. With PX4's default gains it reaches 2.4 m/s at a setpoint of 3, and takes 3 s to stop.
PARAMETERS = {
    "MPC_XY_VEL_P_ACC": 4.0,
    "MPC_XY_VEL_I_ACC": 2.0,
    "EKF2_EV_CTRL": 7,
    "EKF2_EVP_NOISE": 0.02,
    "EKF2_EVV_NOISE": 0.05,
    "EKF2_EV_DELAY": 10.0,
    "EKF2_GPS_CTRL": 0,
    "EKF2_HGT_REF": 3,
}


@contextmanager
def captured(url: str, system: int) -> Iterator[None]:
    """Send measurements until the end of the block. url: a link that no other program uses."""
    link = open_link(url)
    try:
        with repeated(_Cameras(link, system).answer, READ_PERIOD):
            yield
    finally:
        link.close()


class _Cameras:
    """The cameras, as a MAVLink system that sends a measurement for each true position."""

    def __init__(self, link: Link, system: int) -> None:
        self._link, self._system, self._rng = link, system, np.random.default_rng(0)
        self._mav = mavlink.MAVLink(
            self, srcSystem=CAMERAS_ID, srcComponent=mavlink.MAV_COMP_ID_VISUAL_INERTIAL_ODOMETRY
        )
        self._mav.robust_parsing = True
        self._home: Any = None  # the first true position
        self._armed, self._heartbeat_sent = False, -math.inf

    def write(self, data: bytes) -> None:
        """Send bytes; pymavlink calls this."""
        self._link.send(bytes(data))

    def answer(self) -> None:
        """Answer each true position with a measurement."""
        if time.monotonic() - self._heartbeat_sent > 1.0:
            self._heartbeat_sent = time.monotonic()
            self._mav.heartbeat_send(mavlink.MAV_TYPE_ONBOARD_CONTROLLER, mavlink.MAV_AUTOPILOT_INVALID, 0, 0, 0)
            _send_setup(self._mav, self._system, None if self._armed else self._home)
        for message in self._mav.parse_buffer(self._link.receive()) or ():
            if message.get_srcSystem() != self._system:
                continue
            if message.get_type() == "HEARTBEAT":
                self._armed = bool(message.base_mode & mavlink.MAV_MODE_FLAG_SAFETY_ARMED)
            elif message.get_type() == "HIL_STATE_QUATERNION":
                self._home = message if self._home is None else self._home
                _send_measurement(self._mav, message, self._home, self._rng)


def _send_setup(mav: Any, system: int, home: Any) -> None:
    """Request the true positions, and send the place of the hall on Earth."""
    if home is None:
        what = mavlink.MAVLINK_MSG_ID_HIL_STATE_QUATERNION
        mav.command_long_send(
            system, 1, mavlink.MAV_CMD_SET_MESSAGE_INTERVAL, 0, what, 1e6 * MEASUREMENT_PERIOD, *[0.0] * 5
        )
    else:
        mav.set_gps_global_origin_send(system, home.lat, home.lon, home.alt)


def _send_measurement(mav: Any, message: Any, home: Any, rng: np.random.Generator) -> None:
    position = _north_east_down(message, home) + ERROR * rng.normal(size=3)
    velocity = 0.01 * np.array([message.vx, message.vy, message.vz]) + SPEED_ERROR * rng.normal(size=3)
    ned, estimator = mavlink.MAV_FRAME_LOCAL_NED, mavlink.MAV_ESTIMATOR_TYPE_VISION  # PX4 only logs MOCAP
    attitude = list(message.attitude_quaternion)
    rates = message.rollspeed, message.pitchspeed, message.yawspeed
    mav.odometry_send(
        message.time_usec, ned, ned, *position, attitude, *velocity, *rates, UNKNOWN, UNKNOWN, 0, estimator, 100
    )


def _north_east_down(message: Any, home: Any) -> np.ndarray[Any, np.dtype[np.float64]]:
    """Return north, east, down from home, m."""
    narrow = math.cos(math.radians(1e-7 * home.lat))
    north, east = 1e-7 * DEGREE * (message.lat - home.lat), 1e-7 * DEGREE * narrow * (message.lon - home.lon)
    return np.array([north, east, -1e-3 * (message.alt - home.alt)])

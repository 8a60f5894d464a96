"""Simulate the sensors of a real autopilot from the true state.

IMU, magnetometer and barometer become HIL_SENSOR messages, GPS becomes HIL_GPS messages.
"""

from __future__ import annotations

import math

import numpy as np

from brakeline.sim.autopilot import ned_frames
from brakeline.sim.autopilot.common_dialect import mavlink
from brakeline.sim.flight_controller import Vector
from brakeline.sim.flight_estimator import Estimate
from brakeline.sim.sim_conditions import SensorNoise

IMU, MAGNETOMETER, BAROMETER = 0x3F, 0x1C0, 0x1A00  # bits of HIL_SENSOR.fields_updated
FIX = int(mavlink.GPS_FIX_TYPE_RTK_FIXED)
# The Earth's magnetic field at the origin of `ned_frames.globe`: gauss; rad from true north; rad below the horizon
FIELD, DECLINATION, INCLINATION = 0.485, math.radians(3.2), math.radians(63.3)
MAGNETIC_FIELD: Vector = (
    FIELD * math.cos(INCLINATION) * math.cos(DECLINATION),
    FIELD * math.cos(INCLINATION) * math.sin(DECLINATION),
    FIELD * math.sin(INCLINATION),
)  # NED
RATES = (50.0, 25.0, 10.0)  # Hz, of magnetometer, barometer and GPS; the IMU reads at every physics step
DRAWS_AT_ONCE = 256  # one draw alone takes as long as many
DRAW_SIZE = 16  # random numbers for one reading of all sensors
GPS_DRAWS = slice(10, 16)


class HilSensors:
    """The sensors of one vehicle. The generator determines all errors, so a run can be repeated."""

    def __init__(self, noise: SensorNoise, rng: np.random.Generator, period: float) -> None:
        """Draw the biases. period: time between two readings of the IMU [s]."""
        self.noise, self._rng = noise, rng
        self._every = [round(1.0 / rate / period) for rate in RATES]
        n = noise
        sigma = n.scale * np.repeat((n.accelerometer_bias, n.gyro_bias, n.magnetometer_bias, n.barometer_bias), 3)
        bias: list[float] = (sigma * rng.standard_normal(12)).tolist()
        self._force_bias, self._gyro_bias, self._field_bias, self._height_bias = bias[:3], bias[3:6], bias[6:9], bias[9]
        self._draws: list[list[float]] = []
        self._count = 0

    def read(self, truth: Estimate, position: Vector, microseconds: int) -> list[mavlink.MAVLink_message]:
        """Return the messages of one time: HIL_SENSOR with the sensors that are due, and HIL_GPS if it is due.

        Args:
            truth: the true state, as an estimate without errors.
            position: m, ENU, from the origin of `ned_frames.globe`.
            microseconds: the time.
        """
        if not self._draws:
            self._draws = (self.noise.scale * self._rng.standard_normal((DRAWS_AT_ONCE, DRAW_SIZE))).tolist()
        draw, n, count = self._draws.pop(), self.noise, self._count
        magnetic, barometric, fix = (count % every == 0 for every in self._every)
        self._count += 1
        force, rates = ned_frames.body(truth.specific_force), ned_frames.body(truth.rates)
        fields, field, pressure, height = IMU, (0.0, 0.0, 0.0), 0.0, 0.0
        if magnetic:
            fields |= MAGNETOMETER
            field = ned_frames.into_body(ned_frames.attitude(truth.attitude), MAGNETIC_FIELD)
        if barometric:
            fields |= BAROMETER
            height = ned_frames.ALTITUDE + position[2] + self._height_bias + n.barometer * draw[9]
            pressure = 1013.25 * (1.0 - 2.25577e-5 * height) ** 5.25588  # hPa, standard atmosphere
        messages: list[mavlink.MAVLink_message] = [
            mavlink.MAVLink_hil_sensor_message(
                microseconds,
                *(force[i] + self._force_bias[i] + n.accelerometer * draw[i] for i in range(3)),
                *(rates[i] + self._gyro_bias[i] + n.gyro * draw[3 + i] for i in range(3)),
                *(field[i] + self._field_bias[i] + n.magnetometer * draw[6 + i] for i in range(3)),
                pressure, 0.0, height, 15.0, fields,
            )
        ]  # fmt: skip
        if fix:
            messages.append(self._fix(truth, position, microseconds, draw[GPS_DRAWS]))
        return messages

    def _fix(
        self, truth: Estimate, position: Vector, microseconds: int, draw: list[float]
    ) -> mavlink.MAVLink_hil_gps_message:
        where, fast = self.noise.gps_position, self.noise.gps_velocity
        x, y, z = position
        place = ned_frames.globe((x + where * draw[0], y + where * draw[1], z + where * draw[2]))
        vx, vy, vz = truth.velocity
        vn, ve, vd = ned_frames.world((vx + fast * draw[3], vy + fast * draw[4], vz + fast * draw[5]))
        accuracy = max(round(100.0 * self.noise.scale * where), 1)
        course = math.degrees(math.atan2(ve, vn)) % 360.0
        return mavlink.MAVLink_hil_gps_message(
            microseconds, FIX, *place, accuracy, accuracy, round(100.0 * math.hypot(vn, ve)),
            *(round(100.0 * v) for v in (vn, ve, vd)), round(100.0 * course) % 36000, 14,
        )  # fmt: skip

"""The sensors that a real autopilot estimates its state from, made of a simulated vehicle's truth: IMU, magnetometer,
barometer and GPS, as MAVLink's HIL_SENSOR and HIL_GPS carry them."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from brakeline.sim.autopilot import ned_frames
from brakeline.sim.autopilot.common_dialect import mavlink
from brakeline.sim.flight_controller import Vector
from brakeline.sim.flight_estimator import Estimate

IMU, MAGNETOMETER, BAROMETER = 0x3F, 0x1C0, 0x1A00  # of HIL_SENSOR's fields: what is new
FIX = int(mavlink.GPS_FIX_TYPE_RTK_FIXED)
# The Earth's field where `frames.globe` puts the origin: gauss; rad from true north; rad below the horizon
FIELD, DECLINATION, INCLINATION = 0.485, math.radians(3.2), math.radians(63.3)
NORTHWARD: Vector = (
    FIELD * math.cos(INCLINATION) * math.cos(DECLINATION),
    FIELD * math.cos(INCLINATION) * math.sin(DECLINATION),
    FIELD * math.sin(INCLINATION),
)  # NED
CHUNK = 256  # draws at once: one alone costs as much as many
DRAWN = 16  # numbers for one reading of everything


@dataclass(frozen=True)
class SensorNoise:
    """Errors of the sensors: normal, sigma of each axis, anew at each reading; a bias is drawn once. `scale` = 0: none.

    As of a small IMU and an RTK receiver: what is about the vehicle is known on a map to centimetres, and no filter can
    use that behind a position that is wrong by metres. An ordinary receiver has `gps_position` 0.5, `gps_velocity` 0.1.
    """

    scale: float = 1.0  # multiplies every sigma below
    accelerometer: float = 0.05  # m/s²
    accelerometer_bias: float = 0.05  # m/s²
    gyro: float = 0.003  # rad/s
    gyro_bias: float = 0.002  # rad/s
    magnetometer: float = 0.003  # gauss
    magnetometer_bias: float = 0.005  # gauss
    barometer: float = 0.15  # m
    barometer_bias: float = 1.0  # m, of the weather
    gps_position: float = 0.015  # m
    gps_velocity: float = 0.02  # m/s


@dataclass(frozen=True)
class SensorRates:
    """How often a sensor reads, Hz; the IMU at every physics step."""

    magnetometer: float = 50.0
    barometer: float = 25.0
    gps: float = 10.0


class HilSensors:
    """One vehicle's sensors. Everything comes from its generator, so a run can be had again."""

    def __init__(
        self, noise: SensorNoise, rng: np.random.Generator, period: float, rates: SensorRates | None = None
    ) -> None:
        """period: s between two readings of the IMU."""
        rates = rates or SensorRates()
        self.noise, self._rng = noise, rng
        self._every = [round(1.0 / rate / period) for rate in (rates.magnetometer, rates.barometer, rates.gps)]
        n = noise
        sigma = n.scale * np.repeat((n.accelerometer_bias, n.gyro_bias, n.magnetometer_bias, n.barometer_bias), 3)
        bias: list[float] = (sigma * rng.standard_normal(12)).tolist()
        self._force, self._turning, self._field, self._weather = bias[:3], bias[3:6], bias[6:9], bias[9]
        self._draws: list[list[float]] = []
        self._count = 0

    def read(self, truth: Estimate, position: Vector, microseconds: int) -> list[mavlink.MAVLink_message]:
        """What is said at that time: an IMU's reading with whatever else is due, and perhaps a fix of GPS.

        position: m, ENU, from the place that `frames.globe` calls the origin.
        """
        if not self._draws:
            self._draws = (self.noise.scale * self._rng.standard_normal((CHUNK, DRAWN))).tolist()
        draw, n, count = self._draws.pop(), self.noise, self._count
        magnetic, barometric, fix = (count % every == 0 for every in self._every)
        self._count += 1
        force, rates = ned_frames.body(truth.specific_force), ned_frames.body(truth.rates)
        fields, field, pressure, height = IMU, (0.0, 0.0, 0.0), 0.0, 0.0
        if magnetic:
            fields |= MAGNETOMETER
            field = ned_frames.into_body(ned_frames.attitude(truth.attitude), NORTHWARD)
        if barometric:
            fields |= BAROMETER
            height = ned_frames.ALTITUDE + position[2] + self._weather + n.barometer * draw[9]
            pressure = 1013.25 * (1.0 - 2.25577e-5 * height) ** 5.25588  # hPa, of the standard atmosphere
        messages: list[mavlink.MAVLink_message] = [
            mavlink.MAVLink_hil_sensor_message(
                microseconds,
                *(force[i] + self._force[i] + n.accelerometer * draw[i] for i in range(3)),
                *(rates[i] + self._turning[i] + n.gyro * draw[3 + i] for i in range(3)),
                *(field[i] + self._field[i] + n.magnetometer * draw[6 + i] for i in range(3)),
                pressure, 0.0, height, 15.0, fields,
            )
        ]  # fmt: skip
        if fix:
            messages.append(self._fix(truth, position, microseconds, draw[10:]))
        return messages

    def _fix(
        self, truth: Estimate, position: Vector, microseconds: int, draw: list[float]
    ) -> mavlink.MAVLink_hil_gps_message:
        where, fast = self.noise.gps_position, self.noise.gps_velocity
        x, y, z = position
        latitude, longitude, altitude = ned_frames.globe(
            (x + where * draw[0], y + where * draw[1], z + where * draw[2])
        )
        vx, vy, vz = truth.velocity
        vn, ve, vd = ned_frames.world((vx + fast * draw[3], vy + fast * draw[4], vz + fast * draw[5]))
        accuracy = max(round(100.0 * self.noise.scale * where), 1)
        course = math.degrees(math.atan2(ve, vn)) % 360.0
        return mavlink.MAVLink_hil_gps_message(
            microseconds, FIX, round(1e7 * latitude), round(1e7 * longitude), round(1e3 * altitude),
            accuracy, accuracy, round(100.0 * math.hypot(vn, ve)), round(100.0 * vn), round(100.0 * ve),
            round(100.0 * vd), round(100.0 * course) % 36000, 14,
        )  # fmt: skip

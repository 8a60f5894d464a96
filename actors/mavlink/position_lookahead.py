"""Fly a velocity by sending positions ahead of the vehicle; if the setpoints stop, the vehicle stops at the last one.

A position controller asks for a velocity that depends on the distance to its target. PX4 asks for one in proportion to
the distance. ArduPilot does so near the target, and by the square root of the distance beyond, so that it never has to
brake harder than a given acceleration. Each setpoint here is as far ahead as makes the controller ask for the wanted
velocity.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from brakeline.actors.mavlink.telemetry import Array

LATENCY = 0.05  # s, about: from a position measurement to the arrival of the target that is computed from it
PARAMETERS = {  # 1/s, 1/s; of ArduPilot also cm/s², cm/s²
    "ardupilot": ("PSC_POSXY_P", "PSC_POSZ_P", "WPNAV_ACCEL", "WPNAV_ACCEL_Z"),
    "px4": ("MPC_XY_P", "MPC_Z_P"),
}
MASK = 0x0DC0  # position and velocity count; the autopilot ignores acceleration, yaw and yaw rate


@dataclass(frozen=True)
class AxisLookahead:
    """The position controller along some axes.

    gain: 1/s; acceleration: m/s², the largest that it plans to brake with; inf: its command is proportional everywhere.
    """

    gain: float
    acceleration: float

    def distance(self, speed: float) -> float:
        """Return the distance [m] at which the controller asks for a speed [m/s]."""
        proportional = self.acceleration / self.gain
        if speed <= proportional:
            return speed / self.gain
        return 0.5 * (speed**2 / self.acceleration + proportional / self.gain)


@dataclass(frozen=True)
class PositionLookahead:
    """The position controllers across the ground and along the vertical."""

    horizontal: AxisLookahead
    vertical: AxisLookahead

    @staticmethod
    def of(kind: str, values: dict[str, float]) -> PositionLookahead:
        """Build it from the autopilot's `PARAMETERS`.

        Raises:
            ValueError: a parameter is not a positive finite number.
        """
        gains = [values[name] for name in PARAMETERS[kind]]
        if not all(math.isfinite(value) and value > 0.0 for value in gains):
            raise ValueError(", ".join(f"{name} is {values[name]:g}" for name in PARAMETERS[kind]))
        level, climb = (0.01 * value for value in gains[2:]) if kind == "ardupilot" else (math.inf, math.inf)
        return PositionLookahead(AxisLookahead(gains[0], level), AxisLookahead(gains[1], climb))

    def target(self, position: Array, velocity: Array, wanted: Array) -> Array:
        """Return the setpoint (3,) [m] that makes the vehicle fly the velocity `wanted` (3,) [m/s].

        position, velocity: (3,), the latest estimate in m and m/s.
        """
        speed, climb = math.hypot(wanted[0], wanted[1]), float(wanted[2])
        ahead = np.empty(3)
        ahead[:2] = wanted[:2] * (self.horizontal.distance(speed) / speed if speed else 0.0)
        ahead[2] = math.copysign(self.vertical.distance(abs(climb)), climb)
        return np.asarray(position + LATENCY * velocity + ahead)

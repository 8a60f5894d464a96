"""Velocities flown as places ahead, for who flies on for seconds when setpoints stop; at a place it stays.

A position controller asks for a velocity by how far its target is: PX4's in proportion to it; ArduPilot's in proportion
near by, by the square root beyond, so that it never has to brake harder than an acceleration. Told with every setpoint
a target just as far ahead as asks for the velocity that is wanted, it flies that velocity; told nothing more, it stops
there.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from actors.telemetry import Array

AGE = 0.05  # s, about: from where it says that it is to when it hears the target made of it
PARAMETERS = {  # 1/s, 1/s; and of ArduPilot cm/s², cm/s²
    "ardupilot": ("PSC_POSXY_P", "PSC_POSZ_P", "WPNAV_ACCEL", "WPNAV_ACCEL_Z"),
    "px4": ("MPC_XY_P", "MPC_Z_P"),
}
MASK = 0x0DC0  # position and velocity count: acceleration, yaw and yaw rate are to be ignored


@dataclass(frozen=True)
class Lead:
    """gain [1/s] and acceleration [m/s²] (inf: it does not look at how hard it will have to brake) along some axes."""

    gain: float
    acceleration: float

    def distance(self, speed: float) -> float:
        """m, at which it asks for so many m/s."""
        proportional = self.acceleration / self.gain
        if speed <= proportional:
            return speed / self.gain
        return 0.5 * (speed**2 / self.acceleration + proportional / self.gain)


@dataclass(frozen=True)
class Leading:
    across: Lead
    upright: Lead

    @staticmethod
    def of(kind: str, values: dict[str, float]) -> Leading:
        """By its `PARAMETERS`, as it tells them. Raises ValueError: one is no such number."""
        told = [values[name] for name in PARAMETERS[kind]]
        if not all(math.isfinite(value) and value > 0.0 for value in told):
            raise ValueError(", ".join(f"{name} is {values[name]:g}" for name in PARAMETERS[kind]))
        level, vertical = (0.01 * value for value in told[2:]) if kind == "ardupilot" else (math.inf, math.inf)
        return Leading(Lead(told[0], level), Lead(told[1], vertical))

    def target(self, position: Array, velocity: Array, wanted: Array) -> Array:
        """The place (3,) [m] to be told, for who is there, flies so [m/s], and is to fly `wanted` [m/s]."""
        level, climb = math.hypot(wanted[0], wanted[1]), float(wanted[2])
        ahead = np.empty(3)
        ahead[:2] = wanted[:2] * (self.across.distance(level) / level if level else 0.0)
        ahead[2] = math.copysign(self.upright.distance(abs(climb)), climb)
        return np.asarray(position + AGE * velocity + ahead)

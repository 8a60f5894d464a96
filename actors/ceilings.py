"""What a vehicle's parameters allow, beside what the filter may ask of it: held below, it brakes as nobody plans."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from actors.telemetry import GRAVITY
from messaging.robots import Robot


@dataclass(frozen=True)
class Demand:
    """The most that the filter asks for, of a robot in the air: m/s, m/s²."""

    speed: float  # horizontal
    climb: float
    sink: float
    across: float  # horizontal acceleration
    upright: float  # vertical acceleration


def demand(robot: Robot) -> Demand:
    """By the bounds and the slew of its inputs, which are a velocity, ENU."""
    low, high, slew = robot.low(), robot.high(), np.asarray(robot.action_slew) / robot.period
    level = np.maximum(-low[:2], high[:2])
    return Demand(float(np.hypot(*level)), float(high[2]), float(-low[2]), float(np.hypot(*slew[:2])), float(slew[2]))


@dataclass(frozen=True)
class Ceiling:
    """A parameter that holds a vehicle below something; `unit`: one of its units in SI."""

    parameter: str
    what: str
    wanted: Callable[[Demand], float]  # SI
    unit: float = 1.0
    top: float = math.inf  # the largest value that it takes, in its own unit

    def value(self, d: Demand) -> float:
        """What would be enough, in its own unit."""
        return min(math.ceil(10.0 * self.wanted(d) / self.unit) / 10.0, self.top)


def _tilt(d: Demand) -> float:
    return math.degrees(math.atan2(d.across, GRAVITY))


CENTI = 0.01
CEILINGS: dict[str, tuple[Ceiling, ...]] = {
    "px4": (
        Ceiling("MPC_XY_VEL_MAX", "m/s, horizontal", lambda d: d.speed, top=20.0),
        Ceiling("MPC_Z_VEL_MAX_UP", "m/s, climbing", lambda d: d.climb, top=8.0),
        Ceiling("MPC_Z_VEL_MAX_DN", "m/s, sinking", lambda d: d.sink, top=15.0),
        Ceiling("MPC_TILTMAX_AIR", "deg of tilt", _tilt, top=89.0),
    ),
    "ardupilot": (
        Ceiling("WPNAV_SPEED", "cm/s, horizontal", lambda d: d.speed, CENTI, 2000.0),
        Ceiling("WPNAV_SPEED_UP", "cm/s, climbing", lambda d: d.climb, CENTI, 1000.0),
        Ceiling("WPNAV_SPEED_DN", "cm/s, sinking", lambda d: d.sink, CENTI, 500.0),
        Ceiling("WPNAV_ACCEL", "cm/s², horizontal", lambda d: d.across, CENTI, 500.0),
        Ceiling("WPNAV_ACCEL_Z", "cm/s², vertical", lambda d: d.upright, CENTI, 500.0),
        Ceiling("ANGLE_MAX", "hundredths of a degree of tilt", _tilt, CENTI, 8000.0),
    ),
}
TIMEOUTS = {"px4": "COM_OF_LOSS_T", "ardupilot": "GUID_TIMEOUT"}  # s without a setpoint until it brakes by itself
FIXED_TIMEOUT = {"ardupilot": 3.0}  # s, of versions without that parameter
SHORTEST = {"px4": 0.5, "ardupilot": 0.5}  # s, of a timeout that a busy machine's setpoints do not trip


def too_low(kind: str, values: dict[str, float], robot: Robot) -> list[tuple[Ceiling, float]]:
    """The ceilings that are below what may be asked for, each with its value. Unknown ones are none."""
    wanted = demand(robot)
    found = [(ceiling, values[ceiling.parameter]) for ceiling in CEILINGS[kind] if ceiling.parameter in values]
    return [(ceiling, value) for ceiling, value in found if value < ceiling.value(wanted) - 1e-6]

"""Compare an autopilot's parameters with what the filter may ask of the vehicle.

A parameter below the robot's bounds changes how the vehicle brakes, and no plan allows for that.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from brakeline.actors.mavlink.telemetry import GRAVITY
from brakeline.messaging.robot import Robot


@dataclass(frozen=True)
class Demand:
    """The largest speeds [m/s] and accelerations [m/s²] that the filter may ask of a robot in the air."""

    speed: float  # horizontal
    climb: float
    sink: float
    horizontal_acceleration: float
    vertical_acceleration: float


def demand(robot: Robot) -> Demand:
    """Derive the demand from the bounds and the slew of the robot's inputs, which are a velocity (ENU)."""
    low, high, slew = robot.low(), robot.high(), np.asarray(robot.action_slew) / robot.period
    level = np.maximum(-low[:2], high[:2])
    return Demand(float(np.hypot(*level)), float(high[2]), float(-low[2]), float(np.hypot(*slew[:2])), float(slew[2]))


@dataclass(frozen=True)
class AutopilotLimit:
    """A parameter that limits the vehicle.

    what: the limited quantity, for people; required: the value in SI units that meets a demand; unit: the parameter's
    unit in SI; top: the largest value that the parameter takes, in its own unit.
    """

    parameter: str
    what: str
    required: Callable[[Demand], float]
    unit: float = 1.0
    top: float = math.inf

    def value(self, demand: Demand) -> float:
        """Return the smallest sufficient value in the parameter's own unit, or `top` if that is smaller."""
        return min(math.ceil(10.0 * self.required(demand) / self.unit) / 10.0, self.top)


def _tilt(d: Demand) -> float:
    return math.degrees(math.atan2(d.horizontal_acceleration, GRAVITY))


CENTI = 0.01
AUTOPILOT_LIMITS: dict[str, tuple[AutopilotLimit, ...]] = {
    "px4": (
        AutopilotLimit("MPC_XY_VEL_MAX", "m/s, horizontal", lambda d: d.speed, top=20.0),
        AutopilotLimit("MPC_Z_VEL_MAX_UP", "m/s, climbing", lambda d: d.climb, top=8.0),
        AutopilotLimit("MPC_Z_VEL_MAX_DN", "m/s, sinking", lambda d: d.sink, top=15.0),
        AutopilotLimit("MPC_TILTMAX_AIR", "deg of tilt", _tilt, top=89.0),
    ),
    "ardupilot": (
        AutopilotLimit("WPNAV_SPEED", "cm/s, horizontal", lambda d: d.speed, CENTI, 2000.0),
        AutopilotLimit("WPNAV_SPEED_UP", "cm/s, climbing", lambda d: d.climb, CENTI, 1000.0),
        AutopilotLimit("WPNAV_SPEED_DN", "cm/s, sinking", lambda d: d.sink, CENTI, 500.0),
        AutopilotLimit("WPNAV_ACCEL", "cm/s², horizontal", lambda d: d.horizontal_acceleration, CENTI, 500.0),
        AutopilotLimit("WPNAV_ACCEL_Z", "cm/s², vertical", lambda d: d.vertical_acceleration, CENTI, 500.0),
        AutopilotLimit("ANGLE_MAX", "hundredths of a degree of tilt", _tilt, CENTI, 8000.0),
    ),
}
TIMEOUTS = {"px4": "COM_OF_LOSS_T", "ardupilot": "GUID_TIMEOUT"}  # s without a setpoint until it brakes by itself
FIXED_TIMEOUT = {"ardupilot": 3.0}  # s, in versions without that parameter
SHORTEST = {"px4": 0.5, "ardupilot": 0.5}  # s: a busy machine's setpoints do not trip a timeout of this length


def limits_below_demand(kind: str, values: dict[str, float], robot: Robot) -> list[tuple[AutopilotLimit, float]]:
    """Return the limits below the robot's demand, each with its present value.

    kind: `px4` or `ardupilot`; values: parameters by name. A parameter without a value does not count as too low.
    """
    required = demand(robot)
    present = [(limit, values[limit.parameter]) for limit in AUTOPILOT_LIMITS[kind] if limit.parameter in values]
    return [(limit, value) for limit, value in present if value < limit.value(required) - 1e-6]

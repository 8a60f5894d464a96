"""Compare an autopilot's parameters with what the filter may ask of the vehicle.

A parameter below the robot's bounds changes how the vehicle brakes, and no plan allows for that.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from brakeline.actors.mavlink.telemetry import GRAVITY
from brakeline.messaging.robot import Robot


def demand(robot: Robot) -> dict[str, float]:
    """Return the largest speeds [m/s], accelerations [m/s²] and tilt [deg] that the filter may ask of a robot.

    They follow from the bounds and the slew of the robot's inputs, which are a velocity (ENU).
    """
    low, high, slew = robot.low(), robot.high(), np.asarray(robot.action_slew) / robot.period
    acceleration = float(np.hypot(*slew[:2]))
    return {
        "speed": float(np.hypot(*np.maximum(-low[:2], high[:2]))),
        "climb": float(high[2]),
        "sink": float(-low[2]),
        "acceleration": acceleration,
        "vertical acceleration": float(slew[2]),
        "tilt": math.degrees(math.atan2(acceleration, GRAVITY)),
    }


@dataclass(frozen=True)
class AutopilotLimit:
    """A parameter that limits the vehicle."""

    parameter: str
    demand: str  # that it limits
    what: str  # the limited quantity with the parameter's unit, for people
    unit: float  # the parameter's unit in the unit of the demand
    top: float  # the largest value that the parameter takes, in its own unit

    def needed(self, demands: dict[str, float]) -> float:
        """Return the smallest sufficient value in the parameter's own unit. The parameter may not take it (`top`)."""
        return math.ceil(10.0 * demands[self.demand] / self.unit) / 10.0

    def sufficient(self, demands: dict[str, float]) -> float:
        """Return the smallest sufficient value in the parameter's own unit, or `top` if that is smaller."""
        return min(self.needed(demands), self.top)


AUTOPILOT_LIMITS: dict[str, tuple[AutopilotLimit, ...]] = {
    "px4": (
        AutopilotLimit("MPC_XY_VEL_MAX", "speed", "m/s, horizontal", 1.0, 20.0),
        AutopilotLimit("MPC_Z_VEL_MAX_UP", "climb", "m/s, climbing", 1.0, 8.0),
        AutopilotLimit("MPC_Z_VEL_MAX_DN", "sink", "m/s, sinking", 1.0, 15.0),
        AutopilotLimit("MPC_TILTMAX_AIR", "tilt", "deg of tilt", 1.0, 89.0),
    ),
    "ardupilot": (
        AutopilotLimit("WPNAV_SPEED", "speed", "cm/s, horizontal", 0.01, 2000.0),
        AutopilotLimit("WPNAV_SPEED_UP", "climb", "cm/s, climbing", 0.01, 1000.0),
        AutopilotLimit("WPNAV_SPEED_DN", "sink", "cm/s, sinking", 0.01, 500.0),
        AutopilotLimit("WPNAV_ACCEL", "acceleration", "cm/s², horizontal", 0.01, 500.0),
        AutopilotLimit("WPNAV_ACCEL_Z", "vertical acceleration", "cm/s², vertical", 0.01, 500.0),
        AutopilotLimit("ANGLE_MAX", "tilt", "hundredths of a degree of tilt", 0.01, 8000.0),
    ),
}


def limits_below_demand(kind: str, values: dict[str, float], robot: Robot) -> list[tuple[AutopilotLimit, float, float]]:
    """Return the limits below the robot's demand, each with its present and its smallest sufficient value.

    kind: `px4` or `ardupilot`; values: parameters by name. A parameter without a value does not count as too low.
    """
    demands = demand(robot)
    limits = [limit for limit in AUTOPILOT_LIMITS[kind] if limit.parameter in values]
    rows = [(limit, values[limit.parameter], limit.sufficient(demands)) for limit in limits]
    return [(limit, value, needed) for limit, value, needed in rows if value < needed - 1e-6]


def limits_beyond_top(kind: str, values: dict[str, float], robot: Robot) -> list[tuple[AutopilotLimit, float]]:
    """Return the limits that no value of their parameter lifts, each with the value that would suffice.

    kind, values: see `limits_below_demand`.
    """
    demands = demand(robot)
    needs = [(limit, limit.needed(demands)) for limit in AUTOPILOT_LIMITS[kind] if limit.parameter in values]
    return [(limit, needed) for limit, needed in needs if needed > limit.top]

"""The parameters of both rule sets, and their encoding: PX4 sends an integer's bits, ArduPilot casts it to a float."""

from __future__ import annotations

import math
import struct
from dataclasses import dataclass

from brakeline.errors import BadParameter
from brakeline.sim.autopilot.common_dialect import mavlink

INTEGER, REAL = mavlink.MAV_PARAM_TYPE_INT32, mavlink.MAV_PARAM_TYPE_REAL32


@dataclass(frozen=True)
class Parameter:
    """A parameter with its default value, its range and its description."""

    name: str
    value: float  # default
    low: float
    high: float
    description: str
    integer: bool = False

    @property
    def type(self) -> int:
        """MAV_PARAM_TYPE."""
        return int(INTEGER if self.integer else REAL)


PX4_PARAMETERS: tuple[Parameter, ...] = (
    Parameter("COM_DISARM_LAND", 2.0, -1.0, 20.0, "s after a landing until the vehicle disarms"),
    Parameter("COM_DISARM_PRFLT", 10.0, -1.0, 60.0, "s on the ground after arming until the vehicle disarms"),
    Parameter("COM_OBL_RC_ACT", 0, 0, 5, "setpoints lost: 0 to 3 position, 4 land, 5 hold", integer=True),
    Parameter("COM_OF_LOSS_T", 1.0, 0.1, 60.0, "s without a setpoint until the vehicle leaves offboard mode"),
    Parameter("MIS_TAKEOFF_ALT", 2.5, 0.5, 80.0, "m above home to take off to"),
    Parameter("MPC_LAND_SPEED", 0.7, 0.3, 2.0, "m/s"),
    Parameter("MPC_XY_VEL_MAX", 8.0, 0.5, 8.0, "m/s, horizontal"),
    Parameter("MPC_Z_VEL_MAX_DN", 5.0, 0.5, 5.0, "m/s"),
    Parameter("MPC_Z_VEL_MAX_UP", 5.0, 0.5, 5.0, "m/s"),
    Parameter("SYS_AUTOSTART", 4001, 0, 9999999, "airframe", integer=True),
)

ARDUPILOT_PARAMETERS: tuple[Parameter, ...] = (
    Parameter("DISARM_DELAY", 10, 0, 127, "s on the ground after arming until the vehicle disarms", integer=True),
    Parameter("FRAME_CLASS", 1, 0, 15, "1: quadrotor", integer=True),
    Parameter("GUID_TIMEOUT", 3.0, 0.1, 5.0, "s without a setpoint until the vehicle stops"),
    Parameter("LAND_SPEED", 70, 30, 200, "cm/s", integer=True),
    Parameter("WPNAV_ACCEL", 100.0, 1.0, 1e6, "cm/s², with which the flown velocity follows setpoints, horizontal"),
    Parameter("WPNAV_ACCEL_Z", 100.0, 1.0, 1e6, "cm/s², the vertical acceleration"),
    Parameter("WPNAV_SPEED", 500.0, 20.0, 2000.0, "cm/s, horizontal"),
    Parameter("WPNAV_SPEED_DN", 150.0, 10.0, 500.0, "cm/s"),
    Parameter("WPNAV_SPEED_UP", 250.0, 10.0, 1000.0, "cm/s"),
)

# Values with which a vehicle follows setpoints without a limit of acceleration, up to the bounds of the quadrotor's
# description; the recorded data have them.
AT_ONCE: dict[str, dict[str, float]] = {
    "px4": {},
    "ardupilot": {
        **{"WPNAV_SPEED": 800.0, "WPNAV_SPEED_UP": 500.0, "WPNAV_SPEED_DN": 500.0},
        **{"WPNAV_ACCEL": 1e6, "WPNAV_ACCEL_Z": 1e6},
    },
}


class Parameters:
    """The parameters of one vehicle, by name."""

    def __init__(self, table: tuple[Parameter, ...], bitwise: bool) -> None:
        """bitwise: a message has an integer's 32 bits in place of the float's (PX4); else its value (ArduPilot)."""
        self.table, self.bitwise = table, bitwise
        self._values = {parameter.name: parameter.value for parameter in table}

    def __getitem__(self, name: str) -> float:
        return self._values[name]

    def index(self, name: str) -> int:
        """Return the index of a parameter in the table. Raises BadParameter: the parameter does not exist."""
        if name not in self._values:
            raise BadParameter(f"no parameter {name}")
        return list(self._values).index(name)

    def set(self, name: str, value: float) -> None:
        """Set a value.

        Raises:
            BadParameter: the parameter does not exist, or the value is not finite or out of range.
        """
        parameter = self.table[self.index(name)]
        if not (math.isfinite(value) and parameter.low <= value <= parameter.high):
            raise BadParameter(f"{name} is {parameter.low:g} to {parameter.high:g}")
        self._values[name] = float(round(value)) if parameter.integer else value

    def message(self, index: int) -> mavlink.MAVLink_param_value_message:
        parameter = self.table[index]
        value = self._values[parameter.name]
        if parameter.integer and self.bitwise:
            (value,) = struct.unpack("<f", struct.pack("<i", round(value)))
        return mavlink.MAVLink_param_value_message(
            parameter.name.encode(), value, parameter.type, len(self.table), index
        )

    def decode(self, name: str, value: float, kind: int) -> float:
        """Decode the value of a PARAM_SET message.

        Raises:
            BadParameter: the message has another type than the parameter.
        """
        parameter = self.table[self.index(name)]
        if not self.bitwise:
            return value
        if kind != parameter.type:
            raise BadParameter(f"{name} has another type")
        return float(struct.unpack("<i", struct.pack("<f", value))[0]) if parameter.integer else value

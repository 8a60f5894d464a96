"""The rules of PX4 and of ArduCopter: what each accepts and refuses, and its numbers, as a table.

The facts come from the sources of both projects (mavlink_receiver.cpp, Commander.cpp; GCS_MAVLink_Copter.cpp,
mode_guided.cpp). Where versions differ, the table has the stricter one.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

from brakeline.errors import RequestRefused, UnknownMode
from brakeline.sim.autopilot import ned_frames
from brakeline.sim.autopilot.common_dialect import mavlink as m
from brakeline.sim.autopilot.flight_modes import FlightLimits, FlightStateMachine, LandedState, Mode, Setpoint
from brakeline.sim.autopilot.parameters import ARDUPILOT_PARAMETERS, PX4_PARAMETERS, Parameter, Parameters
from brakeline.sim.flight_controller import STILL, Vector

# Bits of SET_POSITION_TARGET_LOCAL_NED.type_mask; each tells the autopilot to ignore a field, except FORCE
POSITION, VELOCITY, ACCELERATION = 0x007, 0x038, 0x1C0
FORCE, YAW, YAW_RATE = 0x200, 0x400, 0x800
LARGEST_VELOCITY = 1000.0  # m/s; ArduCopter takes a larger one as invalid, and stops
PX4_AUTO = 4  # the only main mode with submodes

Target = Any  # SET_POSITION_TARGET_LOCAL_NED; pymavlink has no types


@dataclass(frozen=True)
class AutopilotRules:
    """The rules of one autopilot. Its methods raise RequestRefused."""

    name: str
    autopilot: int  # MAV_AUTOPILOT
    refusal: int  # MAV_RESULT of a command that the autopilot refuses now
    initial_mode: Mode
    parameters: tuple[Parameter, ...]
    bitwise_integers: bool  # integer parameters travel as the bits of a float
    limits: Callable[[Parameters], FlightLimits]
    modes: dict[int, Mode]  # by custom mode
    highest_mode: int  # the highest mode (PX4: main mode) that exists, implemented here or not
    has_submodes: bool  # a custom mode is main << 16 | sub << 24
    ignores_unknown_modes: bool  # the autopilot accepts a mode that does not exist, and does nothing
    not_armable: frozenset[Mode]
    needs_setpoint_stream: bool  # offboard mode starts, and arms, only while setpoints come in
    has_takeoff_mode: bool  # takeoff is a mode; otherwise a command to an armed vehicle in offboard (guided) mode
    reports_bad_setpoints: bool  # otherwise the autopilot ignores them silently
    yaw_is_relative_in_body: bool
    local_frames: tuple[int, ...]  # MAV_FRAMEs of setpoints, in NED
    body_frames: tuple[int, ...]  # MAV_FRAMEs of setpoints, forward-right-down
    takeoff_frames: tuple[int, ...] | None = None  # MAV_FRAMEs of a takeoff command; None: all
    rates: dict[int, float] = field(default_factory=dict)  # Hz, messages that the autopilot sends unrequested
    unsupported: frozenset[int] = frozenset()  # messages that the autopilot does not know
    stream_groups: dict[int, tuple[int, ...]] = field(default_factory=dict)  # messages of REQUEST_DATA_STREAM groups

    def mode_number(self, main: int, sub: int) -> int:
        """Return the custom mode that param2 and param3 of DO_SET_MODE name."""
        return main << 16 | (sub << 24 if main == PX4_AUTO else 0) if self.has_submodes else main

    def custom_mode(self, flight: FlightStateMachine) -> int:
        return next(number for number, mode in self.modes.items() if mode is flight.mode)

    def change(self, flight: FlightStateMachine, custom_mode: int) -> None:
        """Change the mode.

        Raises:
            UnknownMode: the mode does not exist.
            RequestRefused: the mode is not implemented here, or not possible now.
        """
        main, sub = (custom_mode >> 16 & 0xFF, custom_mode >> 24 & 0xFF) if self.has_submodes else (custom_mode, 0)
        if not 0 <= main <= self.highest_mode:
            if self.ignores_unknown_modes:
                return
            raise UnknownMode(f"No such mode {custom_mode}")
        mode = self.modes.get(self.mode_number(main, sub))
        in_the_air = flight.landed is not LandedState.ON_GROUND
        if mode is None or mode is Mode.POSITION or (mode is Mode.MANUAL and in_the_air):
            raise RequestRefused(f"Mode {main}.{sub} not available: no sticks, no mission")
        if mode is Mode.OFFBOARD and self.needs_setpoint_stream and flight.armed and not flight.streaming:
            raise RequestRefused("Offboard: no offboard signal")
        if mode is Mode.TAKEOFF:
            self.take_off(flight, math.nan)
        else:
            flight.change(mode)

    def arm(self, flight: FlightStateMachine) -> None:
        if flight.mode in self.not_armable:
            raise RequestRefused(f"Arming denied: not in {flight.mode.value} mode")
        if flight.mode is Mode.OFFBOARD and self.needs_setpoint_stream and not flight.streaming:
            raise RequestRefused("Arming denied: no offboard signal")
        flight.arm()

    def take_off(self, flight: FlightStateMachine, altitude: float) -> None:
        """Take off.

        Args:
            altitude: param7 of NAV_TAKEOFF [m]. PX4 reads it above sea level (NaN: default), ArduCopter above home.
        """
        if self.has_takeoff_mode:
            flight.change(Mode.TAKEOFF)
            default = flight.home[2] + flight.limits.takeoff_height
            flight.take_off(altitude - ned_frames.ALTITUDE if math.isfinite(altitude) else default)
            return
        if flight.mode is not Mode.OFFBOARD:
            raise RequestRefused("Takeoff: not in guided")
        if not flight.armed:
            raise RequestRefused("Takeoff: not armed")
        if flight.landed is not LandedState.ON_GROUND:
            raise RequestRefused("Takeoff: in the air")
        if not altitude > 0.0:
            raise RequestRefused("Takeoff: no altitude")
        flight.take_off(flight.home[2] + altitude)

    def setpoint(self, flight: FlightStateMachine, target: Target, heading: float) -> None:
        """Take a setpoint. heading: of the vehicle, rad from north.

        A setpoint must have the whole velocity and nothing else but a yaw or a yaw rate.
        """
        fault = self._fault(target)
        invalid = not all(abs(v) <= LARGEST_VELOCITY for v in (target.vx, target.vy, target.vz))  # NaN too
        if self.reports_bad_setpoints:
            if fault or invalid:
                raise RequestRefused(f"SET_POSITION_TARGET_LOCAL_NED {fault or 'invalid velocity'}")
        elif flight.mode is not Mode.OFFBOARD or fault:
            return  # the vehicle follows the setpoint before, until its timeout
        if invalid:
            flight.receive_setpoint(Setpoint(STILL))
        elif flight.limits.lifts_off_by_setpoint or flight.landed is not LandedState.ON_GROUND:
            flight.receive_setpoint(self._converted(target, heading))

    def _fault(self, target: Target) -> str | None:
        """Return the error in the frame or the mask of a setpoint, or None if they are valid."""
        mask, frame = target.type_mask, target.coordinate_frame
        if frame not in self.local_frames + self.body_frames:
            return f"coordinate frame {frame} unsupported"
        if mask & FORCE and mask & ACCELERATION != ACCELERATION:
            return "force not supported"
        if mask & POSITION != POSITION or mask & ACCELERATION != ACCELERATION or mask & VELOCITY:
            return "invalid: all of the velocity, no more"
        return None

    def _converted(self, target: Target, heading: float) -> Setpoint:
        """Return a setpoint in ENU."""
        vx, vy = target.vx, target.vy
        in_body = target.coordinate_frame in self.body_frames
        if in_body:
            cos, sin = math.cos(heading), math.sin(heading)
            vx, vy = cos * vx - sin * vy, sin * vx + cos * vy
        velocity: Vector = ned_frames.world((vx, vy, target.vz))
        yaw, rate = None, None
        if not target.type_mask & YAW and math.isfinite(target.yaw):
            relative = heading if in_body and self.yaw_is_relative_in_body else 0.0
            yaw = ned_frames.yaw(target.yaw + relative)
        elif not target.type_mask & YAW_RATE and math.isfinite(target.yaw_rate):
            rate = -target.yaw_rate
        return Setpoint(velocity, yaw, rate)


def _px4_limits(p: Parameters) -> FlightLimits:
    on_loss = {4: Mode.LAND, 5: Mode.HOLD}.get(round(p["COM_OBL_RC_ACT"]), Mode.POSITION)  # no sticks: it holds
    return FlightLimits(
        setpoint_timeout=p["COM_OF_LOSS_T"],
        on_loss=on_loss,
        lifts_off_by_setpoint=True,
        speed=p["MPC_XY_VEL_MAX"],
        climb=p["MPC_Z_VEL_MAX_UP"],
        sink=p["MPC_Z_VEL_MAX_DN"],
        land_speed=p["MPC_LAND_SPEED"],
        disarm_landed=_delay(p["COM_DISARM_LAND"]),
        disarm_unused=_delay(p["COM_DISARM_PRFLT"]),
        restores_mode=True,
        takeoff_height=p["MIS_TAKEOFF_ALT"],
    )


def _ardupilot_limits(p: Parameters) -> FlightLimits:
    return FlightLimits(
        setpoint_timeout=p["GUID_TIMEOUT"],
        on_loss=Mode.OFFBOARD,
        lifts_off_by_setpoint=False,
        speed=p["WPNAV_SPEED"] / 100.0,
        climb=p["WPNAV_SPEED_UP"] / 100.0,
        sink=p["WPNAV_SPEED_DN"] / 100.0,
        horizontal_acceleration=p["WPNAV_ACCEL"] / 100.0,
        vertical_acceleration=p["WPNAV_ACCEL_Z"] / 100.0,
        land_speed=p["LAND_SPEED"] / 100.0,
        disarm_landed=0.0,
        disarm_unused=p["DISARM_DELAY"] or math.inf,
        restores_mode=False,
    )


def _messages(names: str) -> tuple[int, ...]:
    """Return the ids of messages, named with spaces between."""
    return tuple(getattr(m, f"MAVLINK_MSG_ID_{name}") for name in names.split())


def _delay(parameter: float) -> float:
    """Return a delay [s]; a negative parameter switches it off."""
    return parameter if parameter >= 0.0 else math.inf


PX4 = AutopilotRules(
    name="px4",
    autopilot=m.MAV_AUTOPILOT_PX4,
    refusal=m.MAV_RESULT_TEMPORARILY_REJECTED,
    initial_mode=Mode.HOLD,
    parameters=PX4_PARAMETERS,
    bitwise_integers=True,
    limits=_px4_limits,
    modes={
        3 << 16: Mode.POSITION,
        6 << 16: Mode.OFFBOARD,
        PX4_AUTO << 16 | 2 << 24: Mode.TAKEOFF,
        PX4_AUTO << 16 | 3 << 24: Mode.HOLD,
        PX4_AUTO << 16 | 6 << 24: Mode.LAND,
    },
    highest_mode=10,
    has_submodes=True,
    ignores_unknown_modes=True,
    not_armable=frozenset((Mode.LAND,)),
    needs_setpoint_stream=True,
    has_takeoff_mode=True,
    reports_bad_setpoints=True,
    yaw_is_relative_in_body=False,
    local_frames=(m.MAV_FRAME_LOCAL_NED,),
    body_frames=(m.MAV_FRAME_BODY_NED,),
    rates={
        kind: rate
        for rate, names in (
            (25.0, "ATTITUDE ATTITUDE_QUATERNION LOCAL_POSITION_NED HIGHRES_IMU"),
            (10.0, "GLOBAL_POSITION_INT ODOMETRY VFR_HUD"),
            (5.0, "EXTENDED_SYS_STATE GPS_RAW_INT"),
            (1.0, "SYS_STATUS"),
            (0.5, "HOME_POSITION"),
        )
        for kind in _messages(names)
    },
)

ARDUPILOT = AutopilotRules(
    name="ardupilot",
    autopilot=m.MAV_AUTOPILOT_ARDUPILOTMEGA,
    refusal=m.MAV_RESULT_FAILED,
    initial_mode=Mode.MANUAL,
    parameters=ARDUPILOT_PARAMETERS,
    bitwise_integers=False,
    limits=_ardupilot_limits,
    modes={0: Mode.MANUAL, 4: Mode.OFFBOARD, 5: Mode.HOLD, 9: Mode.LAND, 17: Mode.BRAKE},
    highest_mode=27,
    has_submodes=False,
    ignores_unknown_modes=False,
    not_armable=frozenset((Mode.LAND, Mode.BRAKE)),
    needs_setpoint_stream=False,
    has_takeoff_mode=False,
    reports_bad_setpoints=False,
    yaw_is_relative_in_body=True,
    local_frames=(m.MAV_FRAME_LOCAL_NED, m.MAV_FRAME_LOCAL_OFFSET_NED),
    body_frames=(m.MAV_FRAME_BODY_NED, m.MAV_FRAME_BODY_OFFSET_NED),
    takeoff_frames=(m.MAV_FRAME_GLOBAL_RELATIVE_ALT,),
    unsupported=frozenset(_messages("ATTITUDE_QUATERNION HIGHRES_IMU ODOMETRY")),  # as ArduCopter 4.0
    stream_groups={
        m.MAV_DATA_STREAM_RAW_SENSORS: _messages("SCALED_IMU"),
        m.MAV_DATA_STREAM_EXTENDED_STATUS: _messages("SYS_STATUS GPS_RAW_INT"),
        m.MAV_DATA_STREAM_POSITION: _messages("LOCAL_POSITION_NED GLOBAL_POSITION_INT"),
        m.MAV_DATA_STREAM_EXTRA1: _messages("ATTITUDE"),
        m.MAV_DATA_STREAM_EXTRA2: _messages("VFR_HUD"),
        m.MAV_DATA_STREAM_ALL: _messages(
            "SCALED_IMU SYS_STATUS GPS_RAW_INT LOCAL_POSITION_NED GLOBAL_POSITION_INT ATTITUDE VFR_HUD"
        ),
    },
)

RULES = {rules.name: rules for rules in (PX4, ARDUPILOT)}
SETPOINT_TIMEOUT = {"px4": "COM_OF_LOSS_T", "ardupilot": "GUID_TIMEOUT"}  # the parameters with the timeouts [s]

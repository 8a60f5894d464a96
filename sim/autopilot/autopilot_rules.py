"""What PX4 and what ArduCopter accept, refuse, and call things. Where versions differ, the stricter one's way.

Facts from the two projects' sources (mavlink_receiver.cpp, Commander.cpp; GCS_MAVLink_Copter.cpp, mode_guided.cpp).
"""

from __future__ import annotations

import math
from typing import Any, Protocol

from brakeline.sim.autopilot import ned_frames
from brakeline.sim.autopilot.common_dialect import mavlink
from brakeline.sim.autopilot.flight_modes import (
    CommandRefused,
    FlightLimits,
    FlightStateMachine,
    LandedState,
    Mode,
    Setpoint,
    UnknownMode,
)
from brakeline.sim.autopilot.parameters import ARDUPILOT, PX4, Parameters
from brakeline.sim.flight_controller import STILL, Vector

POSITION, VELOCITY, ACCELERATION = 0x007, 0x038, 0x1C0  # bits of a type mask: these are to be ignored
FORCE, YAW, YAW_RATE = 0x200, 0x400, 0x800
FASTEST = 1000.0  # m/s, a velocity beyond which is no velocity to ArduCopter

PX4_MODES = {
    **{(3, 0): Mode.POSITION, (6, 0): Mode.OFFBOARD},
    **{(4, 2): Mode.TAKEOFF, (4, 3): Mode.HOLD, (4, 6): Mode.LAND},
}  # main, sub
PX4_ON_LOSS = {4: Mode.LAND, 5: Mode.HOLD}  # by COM_OBL_RC_ACT; else sticks would count
COPTER_MODES = {0: Mode.MANUAL, 4: Mode.OFFBOARD, 5: Mode.HOLD, 9: Mode.LAND, 17: Mode.BRAKE}

PX4_LAST, COPTER_LAST = 10, 27  # number of the last main mode, of the last mode

Target = Any  # SET_POSITION_TARGET_LOCAL_NED: pymavlink is untyped


class Rules(Protocol):
    """One autopilot's manners. Its methods raise Refused; `refusal` is the COMMAND_ACK that a refused command gets."""

    name: str
    autopilot: int  # MAV_AUTOPILOT
    refusal: int  # MAV_RESULT of what can't be done now
    boots_in: Mode
    parameters: Parameters
    rates: dict[int, float]  # Hz of messages that are sent without being asked for
    lacks: frozenset[int]  # messages that it does not know
    groups: dict[int, tuple[int, ...]]  # messages of each group of REQUEST_DATA_STREAM

    def limits(self) -> FlightLimits:
        """From the parameters as they are."""

    def command_mode(self, main: int, sub: int) -> int:
        """The custom mode that param2 and param3 of DO_SET_MODE name."""

    def custom_mode(self, pilot: FlightStateMachine) -> int:
        """For HEARTBEAT."""

    def change(self, pilot: FlightStateMachine, custom_mode: int) -> None: ...

    def arm(self, pilot: FlightStateMachine) -> None: ...

    def take_off(self, pilot: FlightStateMachine, altitude: float) -> None:
        """altitude: param7 of NAV_TAKEOFF."""

    def setpoint(self, pilot: FlightStateMachine, target: Target, heading: float) -> None:
        """SET_POSITION_TARGET_LOCAL_NED; heading: of the vehicle, rad from north."""


class Px4:
    """Hold, takeoff, land and offboard; setpoints must stream before offboard, and it holds while the stream stops."""

    name, autopilot = "px4", mavlink.MAV_AUTOPILOT_PX4
    refusal = mavlink.MAV_RESULT_TEMPORARILY_REJECTED
    boots_in = Mode.HOLD
    FRAMES = (mavlink.MAV_FRAME_LOCAL_NED, mavlink.MAV_FRAME_BODY_NED)

    def __init__(self) -> None:
        self.parameters = Parameters(PX4, bitwise=True)
        self.rates = {
            mavlink.MAVLINK_MSG_ID_SYS_STATUS: 1.0,
            mavlink.MAVLINK_MSG_ID_BATTERY_STATUS: 0.5,
            mavlink.MAVLINK_MSG_ID_EXTENDED_SYS_STATE: 5.0,
            mavlink.MAVLINK_MSG_ID_ATTITUDE: 25.0,
            mavlink.MAVLINK_MSG_ID_ATTITUDE_QUATERNION: 25.0,
            mavlink.MAVLINK_MSG_ID_LOCAL_POSITION_NED: 25.0,
            mavlink.MAVLINK_MSG_ID_GLOBAL_POSITION_INT: 10.0,
            mavlink.MAVLINK_MSG_ID_GPS_RAW_INT: 5.0,
            mavlink.MAVLINK_MSG_ID_HIGHRES_IMU: 25.0,
            mavlink.MAVLINK_MSG_ID_ODOMETRY: 10.0,
            mavlink.MAVLINK_MSG_ID_VFR_HUD: 10.0,
            mavlink.MAVLINK_MSG_ID_HOME_POSITION: 0.5,
            mavlink.MAVLINK_MSG_ID_OBSTACLE_DISTANCE: 5.0,
        }
        self.lacks: frozenset[int] = frozenset()
        self.groups: dict[int, tuple[int, ...]] = {}  # it takes no REQUEST_DATA_STREAM

    def limits(self) -> FlightLimits:
        p = self.parameters
        return FlightLimits(
            setpoint_timeout=p["COM_OF_LOSS_T"],
            on_loss=PX4_ON_LOSS.get(round(p["COM_OBL_RC_ACT"]), Mode.POSITION),
            lifts=True,
            speed=p["MPC_XY_VEL_MAX"],
            climb=p["MPC_Z_VEL_MAX_UP"],
            sink=p["MPC_Z_VEL_MAX_DN"],
            land_speed=p["MPC_LAND_SPEED"],
            disarm_landed=_seconds(p["COM_DISARM_LAND"]),
            disarm_unused=_seconds(p["COM_DISARM_PRFLT"]),
            goes_back=True,
        )

    def command_mode(self, main: int, sub: int) -> int:
        return main << 16 | sub << 24

    def custom_mode(self, pilot: FlightStateMachine) -> int:
        main, sub = next(key for key, mode in PX4_MODES.items() if mode is pilot.mode)
        return main << 16 | sub << 24

    def change(self, pilot: FlightStateMachine, custom_mode: int) -> None:
        main, sub = custom_mode >> 16 & 0xFF, custom_mode >> 24 & 0xFF
        mode = PX4_MODES.get((main, sub if main == 4 else 0))
        if main > PX4_LAST:
            return  # accepted, and nothing happens
        if mode in (None, Mode.POSITION):
            raise CommandRefused(f"mode {main}.{sub} is not available: no sticks, no mission")
        if mode is Mode.OFFBOARD and pilot.armed and not pilot.streaming:
            raise CommandRefused("offboard: no offboard signal")
        if mode is Mode.TAKEOFF:
            self.take_off(pilot, math.nan)
        else:
            pilot.change(mode)

    def arm(self, pilot: FlightStateMachine) -> None:
        if pilot.mode is Mode.LAND:
            raise CommandRefused("Arming denied: not in this mode")
        if pilot.mode is Mode.OFFBOARD and not pilot.streaming:
            raise CommandRefused("Arming denied: no offboard signal")
        pilot.arm()

    def take_off(self, pilot: FlightStateMachine, altitude: float) -> None:
        above_home = pilot.home[2] + self.parameters["MIS_TAKEOFF_ALT"]
        pilot.change(Mode.TAKEOFF)
        pilot.take_off(altitude - ned_frames.ALTITUDE if math.isfinite(altitude) else above_home)

    def setpoint(self, pilot: FlightStateMachine, target: Target, heading: float) -> None:
        mask, frame = target.type_mask, target.coordinate_frame
        what = "SET_POSITION_TARGET_LOCAL_NED"
        if frame not in self.FRAMES:
            raise CommandRefused(f"{what} coordinate frame {frame} unsupported")
        if mask & FORCE and mask & ACCELERATION != ACCELERATION:
            raise CommandRefused(f"{what} force not supported")
        if mask & POSITION != POSITION or mask & ACCELERATION != ACCELERATION or mask & VELOCITY:
            raise CommandRefused(f"{what} invalid: all of the velocity, no more")
        velocity = (target.vx, target.vy, target.vz)
        if not all(map(math.isfinite, velocity)):
            raise CommandRefused(f"{what} invalid: not finite")
        pilot.hear(_setpoint(target, frame == mavlink.MAV_FRAME_BODY_NED, heading, relative=False))


class ArduCopter:
    """Guided: armed first, then taken off, then velocities; without new ones it stops."""

    name, autopilot = "ardupilot", mavlink.MAV_AUTOPILOT_ARDUPILOTMEGA
    refusal = mavlink.MAV_RESULT_FAILED
    boots_in = Mode.MANUAL
    BODY = (mavlink.MAV_FRAME_BODY_NED, mavlink.MAV_FRAME_BODY_OFFSET_NED)
    FRAMES = (mavlink.MAV_FRAME_LOCAL_NED, mavlink.MAV_FRAME_LOCAL_OFFSET_NED, *BODY)

    def __init__(self) -> None:
        self.parameters = Parameters(ARDUPILOT, bitwise=False)
        self.rates: dict[int, float] = {}
        m = mavlink
        self.lacks = frozenset(
            (m.MAVLINK_MSG_ID_ATTITUDE_QUATERNION, m.MAVLINK_MSG_ID_HIGHRES_IMU, m.MAVLINK_MSG_ID_ODOMETRY)
        )  # as 4.0
        self.groups: dict[int, tuple[int, ...]] = {
            m.MAV_DATA_STREAM_RAW_SENSORS: (m.MAVLINK_MSG_ID_SCALED_IMU,),
            m.MAV_DATA_STREAM_EXTENDED_STATUS: (m.MAVLINK_MSG_ID_SYS_STATUS, m.MAVLINK_MSG_ID_GPS_RAW_INT),
            m.MAV_DATA_STREAM_POSITION: (m.MAVLINK_MSG_ID_LOCAL_POSITION_NED, m.MAVLINK_MSG_ID_GLOBAL_POSITION_INT),
            m.MAV_DATA_STREAM_EXTRA1: (m.MAVLINK_MSG_ID_ATTITUDE,),
            m.MAV_DATA_STREAM_EXTRA2: (m.MAVLINK_MSG_ID_VFR_HUD,),
        }
        self.groups[m.MAV_DATA_STREAM_ALL] = tuple(kind for kinds in self.groups.values() for kind in kinds)

    def limits(self) -> FlightLimits:
        p = self.parameters
        return FlightLimits(
            setpoint_timeout=p["GUID_TIMEOUT"],
            on_loss=Mode.OFFBOARD,
            lifts=False,
            speed=p["WPNAV_SPEED"] / 100.0,
            climb=p["WPNAV_SPEED_UP"] / 100.0,
            sink=p["WPNAV_SPEED_DN"] / 100.0,
            across=p["WPNAV_ACCEL"] / 100.0,
            upright=p["WPNAV_ACCEL_Z"] / 100.0,
            land_speed=p["LAND_SPEED"] / 100.0,
            disarm_landed=0.0,
            disarm_unused=p["DISARM_DELAY"] or math.inf,
            goes_back=False,
        )

    def command_mode(self, main: int, sub: int) -> int:
        return main

    def custom_mode(self, pilot: FlightStateMachine) -> int:
        return next(number for number, mode in COPTER_MODES.items() if mode is pilot.mode)

    def change(self, pilot: FlightStateMachine, custom_mode: int) -> None:
        mode = COPTER_MODES.get(custom_mode)
        if custom_mode not in range(COPTER_LAST + 1):
            raise UnknownMode(f"No such mode {custom_mode}")
        if mode is None:
            raise CommandRefused(f"Mode change to {custom_mode} failed: no sticks, no mission")
        if mode is Mode.MANUAL and pilot.landed is not LandedState.ON_GROUND:
            raise CommandRefused("Mode change to STABILIZE failed: no sticks")
        pilot.change(mode)

    def arm(self, pilot: FlightStateMachine) -> None:
        if pilot.mode in (Mode.LAND, Mode.BRAKE):
            raise CommandRefused(f"Arm: {pilot.mode.value} mode not armable")
        pilot.arm()

    def take_off(self, pilot: FlightStateMachine, altitude: float) -> None:
        if pilot.mode is not Mode.OFFBOARD:
            raise CommandRefused("Takeoff: not in guided")
        if not pilot.armed:
            raise CommandRefused("Takeoff: not armed")
        if pilot.landed is not LandedState.ON_GROUND:
            raise CommandRefused("Takeoff: in the air")
        if not altitude > 0.0:
            raise CommandRefused("Takeoff: no altitude")
        pilot.take_off(pilot.home[2] + altitude)

    def setpoint(self, pilot: FlightStateMachine, target: Target, heading: float) -> None:
        if pilot.mode is not Mode.OFFBOARD:
            return
        mask, frame = target.type_mask, target.coordinate_frame
        velocity = (target.vx, target.vy, target.vz)
        sane = all(math.isfinite(v) and abs(v) <= FASTEST for v in velocity)
        force = mask & FORCE and not mask & ACCELERATION
        ignores = mask & POSITION and not mask & VELOCITY and mask & ACCELERATION
        if frame not in self.FRAMES or force or not ignores:
            return  # and flies on until no other has come for long
        if not sane:
            pilot.hear(Setpoint(STILL))
        elif pilot.landed is not LandedState.ON_GROUND:
            pilot.hear(_setpoint(target, frame in self.BODY, heading, relative=True))


RULES: dict[str, type[Px4] | type[ArduCopter]] = {kind.name: kind for kind in (Px4, ArduCopter)}

SETPOINT_TIMEOUT = {"px4": "COM_OF_LOSS_T", "ardupilot": "GUID_TIMEOUT"}  # the parameter that sets it, s


def _seconds(parameter: float) -> float:
    """A delay that a negative parameter switches off."""
    return parameter if parameter >= 0.0 else math.inf


def _setpoint(target: Target, in_body: bool, heading: float, relative: bool) -> Setpoint:
    """From NED, or from forward-right-down of a level body, to ENU; relative: in the body's frame, yaw is too."""
    vx, vy = target.vx, target.vy
    if in_body:
        cos, sin = math.cos(heading), math.sin(heading)
        vx, vy = cos * vx - sin * vy, sin * vx + cos * vy
    velocity: Vector = ned_frames.world((vx, vy, target.vz))
    yaw, rate = None, None
    if not target.type_mask & YAW and math.isfinite(target.yaw):
        yaw = ned_frames.yaw(target.yaw + (heading if in_body and relative else 0.0))
    elif not target.type_mask & YAW_RATE and math.isfinite(target.yaw_rate):
        rate = -target.yaw_rate
    return Setpoint(velocity, yaw, rate)

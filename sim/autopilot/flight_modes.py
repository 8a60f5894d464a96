"""The autopilot's flight modes: arming, takeoff, landing, setpoints and their timeout. ENU, SI units."""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import Enum, IntEnum

from brakeline.errors import RequestRefused
from brakeline.sim.flight_controller import STILL, Vector
from brakeline.sim.quadrotor import Quadrotor

TAKEOFF_CLIMB = 1.5  # m/s
TAKEOFF_TOLERANCE = 0.2  # m below its height at which a takeoff is complete
TOUCHDOWN_TIME = 0.3  # s on the floor after which a descending vehicle has landed
LIFT_OFF_CLIMB = 0.1  # m/s, the climb of a setpoint from which a vehicle leaves the floor
READY_AFTER = 1.0  # s after switching on until the estimate is good enough to arm
ROUNDING = 1e-6  # s


class Mode(Enum):
    """The flight modes."""

    MANUAL = "manual"  # by sticks; there are none
    HOLD = "hold"
    POSITION = "position"  # by sticks; there are none, so the vehicle holds
    BRAKE = "brake"
    TAKEOFF = "takeoff"
    LAND = "land"
    OFFBOARD = "offboard"  # by setpoints; ArduCopter's guided mode


class LandedState(IntEnum):
    """The states of MAV_LANDED_STATE."""

    ON_GROUND = 1
    IN_AIR = 2
    TAKING_OFF = 3
    LANDING = 4


@dataclass(frozen=True)
class FlightLimits:
    """The limits that the vehicle's parameters set."""

    setpoint_timeout: float  # s
    on_loss: Mode  # the mode after an offboard stream has stopped; OFFBOARD: brake, and stay in it
    lifts_off_by_setpoint: bool  # an upward setpoint lifts an armed vehicle off the floor
    speed: float  # m/s, horizontal
    climb: float  # m/s
    sink: float  # m/s
    land_speed: float  # m/s
    disarm_landed: float  # s after a landing
    disarm_unused: float  # s from arming without taking off
    restores_mode: bool  # after a landing the vehicle returns to the mode before
    horizontal_acceleration: float = math.inf  # m/s², with which the flown velocity follows setpoints
    vertical_acceleration: float = math.inf  # m/s²
    takeoff_height: float = 0.0  # m above home, of a takeoff without a height


@dataclass(frozen=True)
class Setpoint:
    """A velocity [m/s] in the world, and a yaw [rad], a yaw rate [rad/s] or neither."""

    velocity: Vector
    yaw: float | None = None
    yaw_rate: float | None = None


class FlightStateMachine:
    """The modes of one vehicle. All methods but `tick` act at the present moment."""

    def __init__(self, vehicle: Quadrotor, limits: FlightLimits, mode: Mode) -> None:
        """Start armed and holding if the vehicle flies, otherwise in `mode` on the ground."""
        self.vehicle, self.limits = vehicle, limits
        self.time = 0.0  # s since the vehicle was switched on
        # armed, mode, landed: its state
        self.armed = vehicle.flying
        self.landed = LandedState.IN_AIR if vehicle.flying else LandedState.ON_GROUND
        self.mode = Mode.HOLD if vehicle.flying else mode
        self.home = vehicle.position_and_velocity()[0]  # (x, y, z) m, where it armed last
        self.setpoint = Setpoint(STILL)  # the newest setpoint in offboard mode
        self.last_setpoint = -math.inf  # s, when the newest setpoint came; -inf before the first
        self.announcements: list[str] = []  # texts for the ground station
        self._mode_before_landing = mode
        self._flown_velocity = STILL  # m/s, the setpoint after the limits of acceleration
        self._takeoff_height = 0.0  # m
        self._lost_setpoints = False  # and no other mode was chosen since
        self._since = 0.0  # s, when it armed or landed; in the air: when it last did not press on the floor

    @property
    def streaming(self) -> bool:
        """Whether setpoints come in within their timeout."""
        return self.time - self.last_setpoint <= self.limits.setpoint_timeout + ROUNDING

    def arm(self) -> None:
        """Arm the vehicle. Raises RequestRefused: the estimate is not ready yet."""
        if self.armed:
            return
        if self.time < READY_AFTER:
            raise RequestRefused("the estimate is not ready")
        self.armed, self._since = True, self.time
        self.home = self.vehicle.position_and_velocity()[0]
        self.announcements.append("Armed")
        if self.mode is Mode.TAKEOFF:
            self._leave_floor(LandedState.TAKING_OFF)

    def disarm(self, force: bool = False) -> None:
        """Stop the rotors. Raises RequestRefused: the vehicle is in the air, and `force` is false."""
        if self.landed is not LandedState.ON_GROUND and not force:
            raise RequestRefused("not landed")
        if self.armed:
            self.announcements.append("Disarmed")
        self.armed = False
        self.vehicle.cut_rotors()
        if self.mode is Mode.LAND and self.limits.restores_mode:
            self.mode = self._mode_before_landing

    def change(self, mode: Mode) -> None:
        """Change the mode; the autopilot's rules decide which changes are allowed."""
        if mode is not self.mode:
            self.setpoint = Setpoint(STILL)
            if self.landed in (LandedState.LANDING, LandedState.TAKING_OFF):
                self.landed = LandedState.IN_AIR
        if mode is Mode.LAND and self.mode is not Mode.LAND:
            self._mode_before_landing = self.mode
        self.mode, self._lost_setpoints = mode, False
        if mode is Mode.LAND and self.landed is LandedState.IN_AIR:
            self.landed = LandedState.LANDING

    def take_off(self, height: float) -> None:
        """Climb to a height in the world [m] and hold it. A disarmed vehicle climbs once it is armed."""
        self._takeoff_height = height
        if self.armed and self.landed is LandedState.ON_GROUND:
            self._leave_floor(LandedState.TAKING_OFF)

    def receive_setpoint(self, setpoint: Setpoint) -> None:
        """Follow a setpoint in offboard mode, and ignore it in other modes.

        After a loss of setpoints, the next setpoint returns the vehicle to offboard mode.
        """
        self.last_setpoint = self.time
        if self._lost_setpoints:
            self.announcements.append("Setpoints again")
            self.change(Mode.OFFBOARD)
        if self.mode is not Mode.OFFBOARD:
            return
        self.setpoint = setpoint
        if self.landed is LandedState.TAKING_OFF:
            self.landed = LandedState.IN_AIR

    def tick(self, seconds: float) -> None:
        """Update the state after some time has passed, and steer."""
        self.time += seconds
        if not self.armed:
            return
        if self.mode is Mode.OFFBOARD and not self.streaming:
            self._lose_setpoints()
        descends = self.mode is Mode.LAND or (self.mode is Mode.OFFBOARD and self.setpoint.velocity[2] < 0.0)
        if self.landed is LandedState.ON_GROUND:
            self._rest()
        elif not (self.vehicle.on_floor and descends):
            self._since = self.time
        elif self.time - self._since > TOUCHDOWN_TIME:
            self.landed, self._since = LandedState.ON_GROUND, self.time
            self.vehicle.cut_rotors()
            self.announcements.append("Landing detected")
        self.steer()

    def steer(self, seconds: float = 0.0) -> None:
        """Set the controller's setpoint for the mode, for the next `seconds`."""
        controller, wanted = self.vehicle.controller, self.setpoint
        if self.mode is Mode.OFFBOARD and self.landed is not LandedState.TAKING_OFF:
            self._flown_velocity = controller.setpoint = self._followed(wanted.velocity, seconds)
            controller.turn_at(wanted.yaw_rate or 0.0)
            if wanted.yaw is not None:
                controller.turn_to(wanted.yaw)
            return
        position, self._flown_velocity = self.vehicle.position_and_velocity()
        controller.turn_at(0.0)
        if self.landed is LandedState.TAKING_OFF:
            left = self._takeoff_height - position[2]
            controller.setpoint = (0.0, 0.0, min(max(left, 0.3), TAKEOFF_CLIMB))
            if left < TAKEOFF_TOLERANCE:
                self.landed, controller.setpoint = LandedState.IN_AIR, STILL
                self.mode = Mode.HOLD if self.mode is Mode.TAKEOFF else self.mode
        elif self.mode is Mode.LAND:
            controller.setpoint = (0.0, 0.0, -self.limits.land_speed)
        else:
            controller.setpoint = STILL

    def _followed(self, wanted: Vector, seconds: float) -> Vector:
        """Return the velocity that the limits of speed and acceleration allow after `seconds`, towards a wanted one."""
        limits, (u, v, w) = self.limits, wanted
        level = (u * u + v * v) ** 0.5
        share = min(1.0, limits.speed / level) if level > 0.0 else 1.0
        u, v, w = u * share, v * share, min(max(w, -limits.sink), limits.climb)
        if math.isinf(limits.horizontal_acceleration):
            return (u, v, w)
        x, y, z = self._flown_velocity
        away, most_up = math.hypot(u - x, v - y), limits.vertical_acceleration * seconds
        share = min(1.0, limits.horizontal_acceleration * seconds / away) if away > 0.0 else 1.0
        return (x + share * (u - x), y + share * (v - y), z + min(max(w - z, -most_up), most_up))

    def _lose_setpoints(self) -> None:
        """Brake, and change to the mode of the parameters."""
        stays = self.limits.on_loss is Mode.OFFBOARD
        if stays and self.setpoint.velocity == STILL:
            return
        self.announcements.append("Setpoints lost, braking")
        self.setpoint = Setpoint(STILL)
        if not stays:
            self.change(self.limits.on_loss)
            self._lost_setpoints = self.limits.on_loss is not Mode.LAND

    def _leave_floor(self, landed: LandedState) -> None:
        self.vehicle.start_rotors()
        self.landed = landed

    def _rest(self) -> None:
        """Stand armed on the floor: lift off by a setpoint, or disarm after a delay."""
        rested = self.time - self._since
        upward = self.setpoint.velocity[2] > LIFT_OFF_CLIMB
        if self.mode is Mode.OFFBOARD and self.limits.lifts_off_by_setpoint and upward:
            self._leave_floor(LandedState.IN_AIR)
        elif rested > (self.limits.disarm_landed if self.mode is Mode.LAND else self.limits.disarm_unused):
            self.disarm()

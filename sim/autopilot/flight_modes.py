"""What the autopilot does with its vehicle: modes, arming, takeoff, landing, setpoints and their timeout. ENU, SI."""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import Enum

from brakeline.sim.flight_controller import STILL, Vector
from brakeline.sim.quadrotor import Quadrotor

CLIMB = 1.5  # m/s, of a takeoff
REACHED = 0.2  # m below its height at which a takeoff is done
TOUCHED = 0.3  # s on the floor after which a descending vehicle has landed
UPWARD = 0.1  # m/s, a setpoint's climb from which a vehicle leaves the floor
READY_AFTER = 1.0  # s from switching on until the estimate is good enough to arm
EDGE = 1e-6  # s, rounding of times


class CommandRefused(Exception):
    """The vehicle does not do that now, and why."""


class UnknownMode(CommandRefused):
    """There is no such thing at all."""


class Mode(Enum):
    MANUAL = "manual"  # sticks, of which there are none
    HOLD = "hold"
    POSITION = "position"  # sticks move it; there are none, so it holds
    BRAKE = "brake"
    TAKEOFF = "takeoff"
    LAND = "land"
    OFFBOARD = "offboard"


class LandedState(Enum):
    ON_GROUND = "on the ground"
    TAKING_OFF = "taking off"
    IN_AIR = "in the air"
    LANDING = "landing"


@dataclass(frozen=True)
class FlightLimits:
    """What the vehicle's parameters say."""

    setpoint_timeout: float  # s
    on_loss: Mode  # what follows an offboard stream that stopped; OFFBOARD: brake, and stay
    lifts: bool  # an upward setpoint takes an armed vehicle off the floor
    speed: float  # m/s, horizontal
    climb: float  # m/s
    sink: float  # m/s
    land_speed: float  # m/s
    disarm_landed: float  # s after a landing
    disarm_unused: float  # s from arming without taking off
    goes_back: bool  # once it has landed it is in the mode of before
    across: float = math.inf  # m/s², horizontal, by which the velocity that it flies follows setpoints
    upright: float = math.inf  # m/s², the same up and down


@dataclass(frozen=True)
class Setpoint:
    """A velocity [m/s] in the world, and where to look: a yaw [rad] or a rate of it [rad/s] or neither."""

    velocity: Vector
    yaw: float | None = None
    yaw_rate: float | None = None


class FlightStateMachine:
    """One vehicle's modes. `time` is seconds since it was switched on; all methods but `tick` act at that moment."""

    def __init__(self, vehicle: Quadrotor, limits: FlightLimits, mode: Mode) -> None:
        """It starts as the vehicle does: armed and holding in the air, or in `mode` on the ground."""
        self.vehicle, self.limits = vehicle, limits
        self.time = 0.0
        self.armed = vehicle.flying
        self.landed = LandedState.IN_AIR if vehicle.flying else LandedState.ON_GROUND
        self.mode = Mode.HOLD if vehicle.flying else mode
        self.home = vehicle.position_and_velocity()[0]
        self.setpoint = Setpoint(STILL)
        self.last_setpoint: float | None = None  # s, when one was heard
        self.news: list[str] = []  # for the ground station
        self._before_landing = mode
        self._flown = STILL  # m/s, of a setpoint what it has come to
        self._height = 0.0  # m, of a takeoff
        self._interrupted = False  # it lost its setpoints, and was told nothing else since
        self._since = 0.0  # s, when it armed or landed; in the air: when it last did not press on the floor

    @property
    def streaming(self) -> bool:
        """Setpoints come in, and not too slowly."""
        if self.last_setpoint is None:
            return False
        return self.time - self.last_setpoint <= self.limits.setpoint_timeout + EDGE

    def arm(self) -> None:
        """Raises Refused."""
        if self.armed:
            return
        if self.time < READY_AFTER:
            raise CommandRefused("the estimate is not ready")
        self.armed, self._since = True, self.time
        self.home = self.vehicle.position_and_velocity()[0]
        self.news.append("Armed")
        if self.mode is Mode.TAKEOFF:  # asked for before
            self._leave_floor(LandedState.TAKING_OFF)

    def disarm(self, force: bool = False) -> None:
        """Raises Refused in the air, unless forced."""
        if self.landed is not LandedState.ON_GROUND and not force:
            raise CommandRefused("not landed")
        if self.armed:
            self.news.append("Disarmed")
        self.armed = False
        self.vehicle.cut_rotors()
        if self.mode is Mode.LAND and self.limits.goes_back:
            self.mode = self._before_landing

    def change(self, mode: Mode) -> None:
        """To a mode. What may precede which is the rules' business."""
        if mode is not self.mode:
            self.setpoint = Setpoint(STILL)
            if self.landed in (LandedState.LANDING, LandedState.TAKING_OFF):
                self.landed = LandedState.IN_AIR
        if mode is Mode.LAND and self.mode is not Mode.LAND:
            self._before_landing = self.mode
        self.mode, self._interrupted = mode, False
        if mode is Mode.LAND and self.landed is LandedState.IN_AIR:
            self.landed = LandedState.LANDING

    def take_off(self, height: float) -> None:
        """Climb to a height [m, in the world] and hold it."""
        self._height = height
        if self.armed and self.landed is LandedState.ON_GROUND:
            self._leave_floor(LandedState.TAKING_OFF)

    def hear(self, setpoint: Setpoint) -> None:
        """A setpoint came, to be flown if the mode is offboard, or was until there were none."""
        self.last_setpoint = self.time
        if self._interrupted:
            self.news.append("Setpoints again")
            self.change(Mode.OFFBOARD)
        if self.mode is not Mode.OFFBOARD:
            return
        self.setpoint = setpoint
        if self.landed is LandedState.TAKING_OFF:
            self.landed = LandedState.IN_AIR

    def tick(self, seconds: float) -> None:
        """That much time has passed: see what has become of it, and steer the vehicle's controller."""
        self.time += seconds
        if not self.armed:
            return
        if self.mode is Mode.OFFBOARD and not self.streaming:
            self._lose_setpoints()
        if self.landed is LandedState.ON_GROUND:
            self._rest()
        elif not (self.vehicle.on_floor and self._wants_down()):
            self._since = self.time
        elif self.time - self._since > TOUCHED:
            self._land()
        self.steer()

    def steer(self, seconds: float = 0.0) -> None:
        """Give the controller what the mode asks for now, to be followed for so long."""
        controller, wanted = self.vehicle.controller, self.setpoint
        if self.mode is Mode.OFFBOARD and self.landed is not LandedState.TAKING_OFF:
            self._flown = controller.setpoint = self._following(self._limited(wanted.velocity), seconds)
            controller.yaw_rate = wanted.yaw_rate or 0.0
            if wanted.yaw is not None:
                controller.yaw_goal = wanted.yaw
            return
        self._flown, controller.yaw_rate = self.vehicle.position_and_velocity()[1], 0.0
        if self.landed is LandedState.TAKING_OFF:
            left = self._height - self.vehicle.position_and_velocity()[0][2]
            controller.setpoint = (0.0, 0.0, min(max(left, 0.3), CLIMB))
            if left < REACHED:
                self._arrive()
        elif self.mode is Mode.LAND:
            controller.setpoint = (0.0, 0.0, -self.limits.land_speed)
        else:
            controller.setpoint = STILL

    def _limited(self, velocity: Vector) -> Vector:
        x, y, z = velocity
        level = (x * x + y * y) ** 0.5
        share = min(1.0, self.limits.speed / level) if level > 0.0 else 1.0
        return (x * share, y * share, min(max(z, -self.limits.sink), self.limits.climb))

    def _following(self, wanted: Vector, seconds: float) -> Vector:
        """The velocity on the way to the wanted one that it may come to in that time."""
        limits = self.limits
        if math.isinf(limits.across):
            return wanted
        (x, y, z), (u, v, w) = self._flown, wanted
        away, up = math.hypot(u - x, v - y), limits.upright * seconds
        share = min(1.0, limits.across * seconds / away) if away > 0.0 else 1.0
        return (x + share * (u - x), y + share * (v - y), z + min(max(w - z, -up), up))

    def _lose_setpoints(self) -> None:
        """Nobody asks for anything any more: brake, and do what the parameters say."""
        stays = self.limits.on_loss is Mode.OFFBOARD
        if stays and self.setpoint.velocity == STILL:
            return
        self.news.append("Setpoints lost, braking")
        self.setpoint = Setpoint(STILL)
        if not stays:
            self.change(self.limits.on_loss)
            self._interrupted = self.limits.on_loss is not Mode.LAND

    def _leave_floor(self, landed: LandedState) -> None:
        self.vehicle.start_rotors()
        self.landed = landed

    def _arrive(self) -> None:
        """The height of a takeoff is reached."""
        self.landed = LandedState.IN_AIR
        self.vehicle.controller.setpoint = STILL
        if self.mode is Mode.TAKEOFF:
            self.mode = Mode.HOLD

    def _rest(self) -> None:
        """Armed on the floor, since `_since`."""
        rested = self.time - self._since
        if self.mode is Mode.OFFBOARD and self.limits.lifts and self.setpoint.velocity[2] > UPWARD:
            self._leave_floor(LandedState.IN_AIR)
        elif rested > (self.limits.disarm_landed if self.mode is Mode.LAND else self.limits.disarm_unused):
            self.disarm()

    def _wants_down(self) -> bool:
        return self.mode is Mode.LAND or (self.mode is Mode.OFFBOARD and self.setpoint.velocity[2] < 0.0)

    def _land(self) -> None:
        """It has come down."""
        self.landed, self._since = LandedState.ON_GROUND, self.time
        self.vehicle.cut_rotors()
        self.news.append("Landing detected")

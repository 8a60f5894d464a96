"""A ground station in front of a simulated autopilot, in memory."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from brakeline.messaging.obstacle import Obstacle
from brakeline.sim.arena import Arena
from brakeline.sim.autopilot.common_dialect import mavlink
from brakeline.sim.autopilot.endpoint import Autopilot
from brakeline.sim.autopilot.flight_modes import LandedState
from brakeline.sim.flight_estimator import QuadrotorNoise
from brakeline.sim.quadrotor import Quadrotor
from tests.arenas import staged_arena

LOCAL, BODY, BODY_OFFSET = mavlink.MAV_FRAME_LOCAL_NED, mavlink.MAV_FRAME_BODY_NED, mavlink.MAV_FRAME_BODY_OFFSET_NED
VELOCITY, VELOCITY_YAW, VELOCITY_RATE = 0x0DC7, 0x09C7, 0x05C7
ARM, TAKEOFF, LAND, MODE = 400, 22, 21, 176
ACCEPTED, REJECTED, DENIED, UNSUPPORTED, FAILED = range(5)
GUIDED, COPTER_LAND, BRAKE, AUTO = 4, 9, 17, 3  # ArduCopter's modes
OFFBOARD = 6  # PX4's main mode


def field(*obstacles: Obstacle) -> Arena:
    return staged_arena(*obstacles, start=(0.0, 0.0, 10.0), goal=(9.0, 9.0, 9.0), half_width=500.0, height=500.0)


class Station:
    """A ground station on an in-memory link."""

    def __init__(self, rules: str = "px4", airborne: bool = False, **options: Any) -> None:
        arena = options.pop("arena", field())
        vehicle = Quadrotor(
            arena, np.random.default_rng(0), QuadrotorNoise(scale=0.0), floor=None if airborne else 0.02
        )
        self.autopilot = Autopilot(vehicle, rules, **options)
        self.flight = self.autopilot.flight
        self.received: list[Any] = []
        self.mav = mavlink.MAVLink(self, srcSystem=255, srcComponent=190)

    def write(self, data: bytes) -> None:
        self.autopilot.receive(data)
        self.listen()

    def listen(self) -> None:
        self.received += self.mav.parse_buffer(self.autopilot.take()) or []

    def wait(self, seconds: float) -> None:
        self.autopilot.advance(seconds)
        self.listen()

    def last(self, kind: str) -> Any:
        return [message for message in self.received if message.get_type() == kind][-1]

    def texts(self) -> str:
        return "; ".join(message.text for message in self.received if message.get_type() == "STATUSTEXT")

    def command(self, number: int, *params: float, system: int = 1) -> int:
        self.received.clear()
        self.mav.command_long_send(system, 1, number, 0, *params, *[0.0] * (7 - len(params)))
        ack = self.last("COMMAND_ACK")
        assert (ack.command, ack.target_system, ack.target_component) == (number, 255, 190)
        return int(ack.result)

    def setpoint(self, vx: float, vy: float, vz: float, frame: int = LOCAL, mask: int = VELOCITY, **yaw: float) -> None:
        self.mav.set_position_target_local_ned_send(
            0, 1, 1, frame, mask, 0, 0, 0, vx, vy, vz, 0, 0, 0, yaw.get("yaw", 0.0), yaw.get("rate", 0.0)
        )

    def fly(self, *setpoint: float, seconds: float = 2.0, **options: Any) -> np.ndarray:
        """Send a setpoint every 0.1 s; return the true velocity afterwards, in NED."""
        for _ in range(round(seconds / 0.1)):
            self.setpoint(*setpoint, **options)
            self.wait(0.1)
        east, north, up = self.autopilot.vehicle.state()[3:6]
        return np.array([north, east, -up])

    def follow_setpoints(self) -> None:
        self.setpoint(0, 0, 0)
        assert self.command(MODE, 1, OFFBOARD if self.autopilot.rules.name == "px4" else GUIDED) == ACCEPTED

    def take_off(self) -> None:
        """Take off, and change to the mode that follows setpoints."""
        self.wait(2.0)
        px4 = self.autopilot.rules.name == "px4"
        if not px4:
            self.follow_setpoints()
        assert self.command(ARM, 1) == ACCEPTED
        assert self.command(TAKEOFF, *[0.0] * 6, math.nan if px4 else 3.0) == ACCEPTED
        self.wait(6.0)
        if px4:
            self.follow_setpoints()
        assert self.flight.landed is LandedState.IN_AIR

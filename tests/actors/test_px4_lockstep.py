"""A period behind PX4 in lockstep counts only if PX4 followed the setpoint, and its state is new. PX4 is a stand-in."""

from __future__ import annotations

import contextlib
import socket
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from brakeline.actors.mavlink.ardupilot_dialect import mavlink
from brakeline.actors.mavlink.autopilot_commands import AutopilotClient
from brakeline.actors.mavlink.px4_lockstep import OLDEST, Px4Flight, Px4Vehicle
from brakeline.errors import AutopilotGone
from brakeline.messaging.obstacle import CYLINDER, Obstacle
from brakeline.sim.quadrotor import Quadrotor
from brakeline.sim.sim_conditions import SensorNoise
from tests.actors.test_lockstep_quadrotor import quadrotor
from tests.robots import QUADROTOR

OFFBOARD, HOLD = 6 << 16, 4 << 16 | 3 << 24
WALL = Obstacle(CYLINDER, (1.2, 0.0, 10.0), (0.5, 10.0))


class StandIn:
    """The simulator's end of a PX4 that hovers, and sends its state."""

    def __init__(self, vehicle: Quadrotor, link: socket.socket) -> None:
        self.vehicle, self.shift, self.armed, self.time = vehicle, (0.0, 0.0, 0.0), True, 100.0
        self.mode, self.silent, self.offset = OFFBOARD, False, 0.0
        self._link, self._mav = link, mavlink.MAVLink(None, srcSystem=1, srcComponent=1)

    def tick(self) -> None:
        self.vehicle.advance(4)
        self.time += 0.005
        if self.silent:
            return
        ms, us = round(1e3 * self.time), round(1e6 * self.time)
        for message in (
            mavlink.MAVLink_local_position_ned_message(ms, self.offset, 0, -10, 0, 0, 0),
            mavlink.MAVLink_attitude_quaternion_message(ms, 1, 0, 0, 0, 0, 0, 0),
            mavlink.MAVLink_highres_imu_message(us, 0, 0, -9.81, *[0] * 10, 0),
            mavlink.MAVLink_heartbeat_message(2, mavlink.MAV_AUTOPILOT_PX4, 129, self.mode, 4, 3),
        ):
            self._link.sendto(message.pack(self._mav), self._link.getsockname())


@contextlib.contextmanager
def episode(*obstacles: Obstacle) -> Iterator[tuple[Px4Vehicle, StandIn]]:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as link:
        link.bind(("127.0.0.1", 0))
        link.setblocking(False)
        hil = StandIn(quadrotor(), link)

        class Flight(Px4Flight):
            def _begin(self) -> None:
                self.hil, self._link = hil, link  # type: ignore[assignment]
                self.client = AutopilotClient(lambda _: None, tap=self._on_frame)
                self.advance(0.2)

        yield Px4Vehicle(Flight(Path(), SensorNoise()), quadrotor(*obstacles), QUADROTOR), hil


def test_a_period_that_px4_follows_counts() -> None:
    with episode() as (vehicle, _):
        for _ in range(3):
            assert not vehicle.step(np.zeros(3)).collision


@pytest.mark.parametrize(
    ("change", "why"),
    [
        ({"mode": HOLD}, r"does not follow our setpoints \(HOLD\)"),
        ({"armed": False}, r"does not follow our setpoints \(it is disarmed\)"),
        ({"silent": True}, r"no newer telemetry: the latest is 0\.20 s old"),
        ({"offset": 2.0}, r"its position jumped by 2\.00 m"),
    ],
)
def test_a_period_that_px4_does_not_follow_or_whose_state_is_old_is_no_period(change, why) -> None:
    with episode() as (vehicle, hil):
        vehicle.step(np.zeros(3))
        vars(hil).update(change)
        with pytest.raises(AutopilotGone, match=why):
            vehicle.step(np.zeros(3))


def test_px4_that_leaves_offboard_and_returns_within_a_period_did_not_follow() -> None:
    with episode() as (vehicle, hil):
        hil.mode = HOLD
        vehicle._flight.advance(0.05)
        hil.mode = OFFBOARD
        with pytest.raises(AutopilotGone, match="HOLD"):
            vehicle.step(np.zeros(3))


def test_a_state_is_extrapolated_by_a_limited_time() -> None:
    with episode() as (vehicle, hil):
        hil.silent = True
        vehicle._flight.client.velocity = np.array([4.0, 0.0, 0.0])
        before = vehicle._estimate()[0]
        hil.time += 10.0
        assert vehicle._estimate()[0] - before == pytest.approx(4.0 * OLDEST, abs=0.01)


def test_the_period_of_a_collision_counts_even_if_it_disarms_px4() -> None:
    with episode(WALL) as (vehicle, hil):
        hil.vehicle.controller.setpoint = (3.0, 0.0, 0.0)
        for _ in range(20):
            hil.armed = hil.armed and not hil.vehicle.collided
            try:
                period = vehicle.step(np.zeros(3))
            except AutopilotGone:
                raise AssertionError("the collision is not reported") from None
            if period.collision:
                break
        assert period.collision

"""Telemetry that is too old brakes a vehicle. One that disarmed, restarted or jumped is not flown any more, and a
second vehicle with the same system id is refused.
"""

from __future__ import annotations

import math
import re
from typing import Any

import pytest

from brakeline.actors.mavlink.ardupilot_dialect import mavlink
from brakeline.actors.mavlink.flight_timing import ClockOffset, FlightTiming
from brakeline.actors.mavlink.flight_watch import FlightWatch
from brakeline.actors.mavlink.mavlink_decoder import OFFBOARD, MavlinkDecoder
from brakeline.actors.mavlink.telemetry import MOTION
from brakeline.errors import BadMessage

STEP = 0.02  # s between two positions
BEGIN = 100.0  # s of our clock, and since the autopilot was switched on
MAV = mavlink.MAVLink(None, srcSystem=1, srcComponent=1)


def heartbeat(armed: bool = True, state: int = mavlink.MAV_STATE_ACTIVE) -> bytes:
    mode = mavlink.MAV_MODE_FLAG_SAFETY_ARMED if armed else 0
    px4, number = mavlink.MAV_AUTOPILOT_PX4, OFFBOARD["px4"][1]
    return bytes(mavlink.MAVLink_heartbeat_message(2, px4, mode, number, state, 3).pack(MAV))


def position(time: float, north: float = 0.0, speed: float = 0.0) -> bytes:
    return bytes(mavlink.MAVLink_local_position_ned_message(round(1e3 * time), north, 0, -3, speed, 0, 0).pack(MAV))


def odometry(time: float, resets: int, frame: int = 1) -> bytes:
    none: Any = [math.nan] + [0.0] * 20
    pose = (0.0, 0.0, -3.0, (1.0, 0.0, 0.0, 0.0))
    message = mavlink.MAVLink_odometry_message(round(1e6 * time), frame, 1, *pose, *[0] * 6, none, none, resets)
    return bytes(message.pack(MAV))


class WatchedFlight:
    """A vehicle that hovers, behind a link with a delay; its clock may jump."""

    def __init__(self) -> None:
        self.client, self.timing = MavlinkDecoder(lambda _: None), FlightTiming()
        self.watch = FlightWatch(self.client, self.timing)
        self.now, self.delay, self.jump, self.answers = BEGIN, 0.005, 0.0, True  # delay: s, each way
        self.north, self.speed = 0.0, 0.0  # m, m/s

    def pause(self, seconds: float, setpoint: float) -> None:
        """Receive nothing for some seconds, while the vehicle follows a setpoint [m/s]."""
        for _ in range(round(seconds / STEP)):
            self.now += STEP
            self.watch.note(self.now, setpoint)

    def fly(self, seconds: float) -> str:
        """Receive telemetry for some seconds. Return why it is lost in the end."""
        for k in range(round(seconds / STEP)):
            self.now += STEP
            theirs = self.now - self.delay - self.jump
            if theirs <= self.client.time:
                continue  # what was sent before has arrived, and what is sent since then is on its way
            attitude = mavlink.MAVLink_attitude_message(round(1e3 * theirs), *[0] * 6).pack(MAV)
            force = mavlink.MAVLink_highres_imu_message(0, 0, 0, -9.81, *[0] * 10, 0).pack(MAV)
            self.client.feed(heartbeat() + position(theirs, self.north, self.speed) + bytes(attitude) + bytes(force))
            if k % 25 == 0 and self.answers:
                asked = round(1e9 * (self.now - 2.0 * self.delay))
                self.watch.clock_requested(asked)
                self.client.feed(bytes(mavlink.MAVLink_timesync_message(round(1e9 * theirs), asked).pack(MAV)))
            self.watch.note(self.now)
        return self.watch.lost(self.now)


@pytest.fixture
def flight() -> WatchedFlight:
    flight = WatchedFlight()
    assert flight.fly(2.0) == "" and flight.timing.round_trip == pytest.approx(0.01, abs=1e-6)
    return flight


@pytest.mark.parametrize("delay", [0.5, 1.5, 4.0])
@pytest.mark.parametrize("answers", [True, False])
def test_a_link_that_becomes_slower_is_lost_telemetry_until_it_is_fast_again(
    flight: WatchedFlight, delay: float, answers: bool
) -> None:
    """Such a delay once counted as a jump of the autopilot's clock, and old positions as fresh."""
    flight.delay, flight.answers = delay, answers
    assert "no telemetry of position" in flight.fly(delay - 0.1)
    for _ in range(5):
        assert "telemetry arrives too late: no newer position for" in flight.fly(2.0)
    assert flight.watch.age(flight.now) == pytest.approx(delay, abs=0.02)
    flight.delay = 0.005
    assert flight.fly(0.1) == ""


@pytest.mark.parametrize("jump", [0.3, 5.0])
def test_a_clock_that_jumped_is_followed_once_a_fast_reply_proves_it(flight: WatchedFlight, jump: float) -> None:
    flight.jump, flight.answers = jump, False
    assert "no telemetry of position" in flight.fly(jump)  # as a simulator that stalls
    assert "telemetry arrives too late" in flight.fly(3.0)
    flight.answers = True
    assert flight.fly(1.0) == "" and flight.watch.age(flight.now) == pytest.approx(0.0, abs=0.02)


def test_a_link_that_was_slow_from_the_beginning_is_lost_telemetry() -> None:
    flight = WatchedFlight()
    flight.delay = 0.6
    assert "telemetry arrives too late" in flight.fly(2.0)


def test_replies_to_other_stations_do_not_count(flight: WatchedFlight) -> None:
    flight.client.feed(bytes(mavlink.MAVLink_timesync_message(1, round(1e9 * (flight.now + 50.0))).pack(MAV)))
    assert flight.fly(0.1) == "" and flight.timing.round_trip == pytest.approx(0.01, abs=1e-6)


def test_the_clock_offset_ignores_late_messages_and_follows_jumps_that_a_reply_proves() -> None:
    offset = ClockOffset()
    for k in range(1000):
        offset.note(0.02 * k + 0.001 * (k % 7), 0.02 * k)
    assert offset.value == pytest.approx(0.0, abs=1e-4)
    for k in range(1000, 1040):
        offset.note(0.02 * k + 0.03, 0.02 * k)  # all are late for a while
    assert offset.value == pytest.approx(0.0, abs=1e-3)
    for k in range(1040, 1240):
        offset.note(0.02 * k, 0.02 * k - 0.5)  # late, or the autopilot's clock jumped
    assert offset.value == pytest.approx(0.0, abs=2e-3)
    offset.answer(24.0, 24.01 - 0.5, 0.02)
    assert offset.value == pytest.approx(0.51, abs=1e-3)
    offset.note(25.0, 24.9)
    assert offset.value == pytest.approx(0.1)


def test_a_position_that_is_not_newer_does_not_count(flight: WatchedFlight) -> None:
    client, last = flight.client, flight.client.time
    before, positions = client.message_counts[MOTION], len(client.path)
    client.feed(position(last, north=0.1) + position(last - 0.5, north=0.1))
    assert client.message_counts[MOTION] == before and len(client.path) == positions
    assert client.position is not None and client.position[1] == 0.0 and client.interruption == ""


@pytest.mark.parametrize(
    ("frames", "why"),
    [
        ([heartbeat(armed=False), heartbeat()], "it has disarmed"),
        ([position(0.4)], r"it has restarted: its time since boot went from 102\.0 s back to 0\.4 s"),
        ([odometry(102.1, 3), odometry(102.2, 4)], "its estimator has reset its position, velocity or attitude"),
        ([position(102.02, north=1.5)], r"its position jumped by 1\.50 m within 0\.0[23] s"),
    ],
)
def test_an_interruption_ends_our_command_for_good(flight: WatchedFlight, frames: list[bytes], why: str) -> None:
    for frame in frames:
        flight.client.feed(frame)
    for _ in range(3):
        assert re.fullmatch(f"our command of the vehicle has ended: {why}", flight.fly(1.0))


@pytest.mark.parametrize(
    ("gap", "setpoint", "speed", "north", "jumps"),
    [
        (5.0, 0.0, 0.0, 3.0, True),  # the autopilot has begun anew, or its localisation was set
        (60.0, 0.0, 0.0, -20.0, True),
        (5.0, 0.0, 0.0, 0.9, False),  # a hover drifts
        (5.0, 1.0, 0.0, 5.0, False),  # the committed plan flies on
        (5.0, 0.0, 4.0, 8.0, False),  # it brakes late
        (5.0, 1.0, 1.0, 9.0, True),
    ],
)
def test_a_position_beyond_the_reach_of_a_gap_of_telemetry_is_in_another_frame(
    flight: WatchedFlight, gap: float, setpoint: float, speed: float, north: float, jumps: bool
) -> None:
    """Before, the vehicle counted as accelerating by 10 m/s² during the whole gap: 60 m after 5 s were no jump."""
    flight.speed = speed
    flight.fly(STEP)
    flight.pause(gap, setpoint)
    flight.north, flight.speed = north, 0.0
    why = (
        r"our command of the vehicle has ended: its position jumped by \d+\.\d\d m in a gap of \d+\.\d\d s, farther .*"
    )
    for _ in range(3):
        assert re.fullmatch(why if jumps else "", flight.fly(1.0))


def test_flying_is_no_interruption() -> None:
    """Neither are gaps, hard braking, an estimate that moves a little, and odometry in another frame."""
    client = MavlinkDecoder(lambda _: None)
    client.feed(heartbeat() + position(1.0, speed=7.0) + position(1.5, north=2.6, speed=5.0))
    client.feed(position(2.5, north=5.1) + position(2.52, north=5.4))
    client.feed(odometry(2.53, 1) + odometry(2.54, 2, frame=20) + odometry(2.55, 1) + heartbeat())
    assert client.interruption == ""


@pytest.mark.parametrize("state", range(9))
def test_a_critical_state_an_emergency_power_off_and_flight_termination_are_emergencies(
    flight: WatchedFlight, state: int
) -> None:
    flight.client.feed(heartbeat(state=state))
    names = ("CRITICAL", "EMERGENCY", "POWEROFF", "FLIGHT_TERMINATION")
    emergency = state in [getattr(mavlink, f"MAV_STATE_{name}") for name in names]
    lost = flight.watch.lost(flight.now)
    assert lost == ("the autopilot says that it is in an emergency" if emergency else "")


def test_a_second_vehicle_with_the_same_id_is_refused_and_both_are_named() -> None:
    client, other = MavlinkDecoder(lambda _: None), mavlink.MAVLink(None, srcSystem=2, srcComponent=1)
    client.feed(bytes(position_of_another(other)), "10.0.0.3:14550")  # another id: it may be anywhere
    client.feed(heartbeat() + position(5.0), "10.0.0.1:14550")
    with pytest.raises(BadMessage, match=r"vehicle 1 is at 10\.0\.0\.1:14550.*also come from 10\.0\.0\.2:14550"):
        client.feed(heartbeat(armed=False) + position(0.1, north=50.0), "10.0.0.2:14550")
    assert client.armed and client.position is not None and client.position[1] == 0.0 and client.interruption == ""
    client.feed(position(5.02), "10.0.0.1:14550")
    assert client.time == pytest.approx(5.02) and client.second_source == "10.0.0.2:14550"


def position_of_another(mav: Any) -> bytes:
    return bytes(mavlink.MAVLink_local_position_ned_message(0, 9.0, 0, 0, 0, 0, 0).pack(mav))

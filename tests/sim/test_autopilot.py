"""The autopilot at the level of its bytes: what it accepts, what it refuses, what it says, with both rule sets."""

from __future__ import annotations

import math
import struct
from typing import Any

import numpy as np
import pytest

from messaging.shapes import CYLINDER, Obstacle
from messaging.tasks import task_of
from sim.autopilot import frames
from sim.autopilot.dialect import mavlink
from sim.autopilot.endpoint import TICK, Autopilot, UnknownRules
from sim.autopilot.parameters import BadParameter
from sim.autopilot.pilot import Landed, Mode
from sim.autopilot.telemetry import BINS, obstacle_bins
from sim.flight_estimator import QuadrotorNoise
from sim.lidar import Lidar
from sim.quadrotor import Quadrotor
from sim.world import Arena, staged_arena
from tests.robots import QUADROTOR

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
        self.pilot = self.autopilot.pilot
        self.heard: list[Any] = []
        self.mav = mavlink.MAVLink(self, srcSystem=255, srcComponent=190)

    def write(self, data: bytes) -> None:
        self.autopilot.receive(data)
        self.listen()

    def listen(self) -> None:
        self.heard += self.mav.parse_buffer(self.autopilot.take()) or []

    def wait(self, seconds: float) -> None:
        self.autopilot.advance(seconds)
        self.listen()

    def last(self, kind: str) -> Any:
        return [message for message in self.heard if message.get_type() == kind][-1]

    def texts(self) -> str:
        return "; ".join(message.text for message in self.heard if message.get_type() == "STATUSTEXT")

    def command(self, number: int, *params: float, system: int = 1) -> int:
        """The result of a command."""
        self.heard.clear()
        self.mav.command_long_send(system, 1, number, 0, *params, *[0.0] * (7 - len(params)))
        ack = self.last("COMMAND_ACK")
        assert (ack.command, ack.target_system, ack.target_component) == (number, 255, 190)
        return int(ack.result)

    def setpoint(self, vx: float, vy: float, vz: float, frame: int = LOCAL, mask: int = VELOCITY, **yaw: float) -> None:
        self.mav.set_position_target_local_ned_send(
            0, 1, 1, frame, mask, 0, 0, 0, vx, vy, vz, 0, 0, 0, yaw.get("yaw", 0.0), yaw.get("rate", 0.0)
        )

    def fly(self, *setpoint: float, seconds: float = 2.0, **options: Any) -> np.ndarray:
        """Stream a setpoint; the true velocity after it, in NED."""
        for _ in range(round(seconds / 0.1)):
            self.setpoint(*setpoint, **options)
            self.wait(0.1)
        east, north, up = self.autopilot.vehicle.state()[3:6]
        return np.array([north, east, -up])

    def into_the_air(self) -> None:
        """Take off to three metres, and be ready for setpoints."""
        self.wait(2.0)
        if self.autopilot.rules.name == "px4":
            assert self.command(ARM, 1) == ACCEPTED
            assert self.command(TAKEOFF, *[0.0] * 6, math.nan) == ACCEPTED
            self.wait(6.0)
            self.setpoint(0, 0, 0)
            assert self.command(MODE, 1, OFFBOARD) == ACCEPTED
        else:
            assert self.command(MODE, 1, GUIDED) == ACCEPTED
            assert self.command(ARM, 1) == ACCEPTED
            assert self.command(TAKEOFF, *[0.0] * 6, 3.0) == ACCEPTED
            self.wait(6.0)
        assert self.pilot.landed is Landed.IN_AIR


@pytest.fixture(params=["px4", "ardupilot"])
def station(request: pytest.FixtureRequest) -> Station:
    return Station(request.param)


@pytest.fixture(params=["px4", "ardupilot"])
def flying(request: pytest.FixtureRequest) -> Station:
    station = Station(request.param)
    station.into_the_air()
    return station


def test_heartbeat_says_who_it_is_once_a_second(station: Station) -> None:
    station.wait(5.0)
    beats = [m for m in station.heard if m.get_type() == "HEARTBEAT"]
    assert len(beats) == 6  # one at once
    assert beats[0].type == mavlink.MAV_TYPE_QUADROTOR
    assert beats[0].autopilot == {"px4": 12, "ardupilot": 3}[station.autopilot.rules.name]
    assert beats[0].get_msgbuf()[0] == 0xFD  # MAVLink 2


def test_it_takes_off_lands_and_disarms(flying: Station) -> None:
    height = flying.autopilot.vehicle.state()[2]
    assert height == pytest.approx({"px4": 2.55, "ardupilot": 3.05}[flying.autopilot.rules.name], abs=0.25)
    assert flying.command(ARM, 0) == flying.autopilot.rules.refusal  # not in the air
    assert flying.command(LAND) == ACCEPTED
    flying.wait(1.0)
    assert flying.pilot.landed is Landed.LANDING
    flying.wait(10.0)
    assert flying.pilot.landed is Landed.ON_GROUND and not flying.pilot.armed
    assert not flying.autopilot.vehicle.collided
    assert "Landing detected" in flying.texts()


def test_arming_is_checked(station: Station) -> None:
    refusal = station.autopilot.rules.refusal
    assert station.command(ARM, 1) == refusal  # the estimate needs a second
    station.wait(2.0)
    assert station.command(ARM, 0.5) == UNSUPPORTED
    assert station.command(ARM, 1) == ACCEPTED
    assert station.command(ARM, 0) == ACCEPTED
    land = (4, 6) if refusal == REJECTED else (COPTER_LAND,)
    assert station.command(MODE, 1, *land) == ACCEPTED
    assert station.command(ARM, 1) == refusal


def test_unused_it_disarms_by_itself(station: Station) -> None:
    station.wait(2.0)
    station.command(ARM, 1)
    station.wait(9.0)
    assert station.pilot.armed
    station.wait(2.0)
    assert not station.pilot.armed


def test_px4_wants_setpoints_before_offboard() -> None:
    station = Station("px4")
    station.wait(2.0)
    assert station.command(MODE, 1, OFFBOARD) == ACCEPTED  # disarmed: it may be any
    assert station.command(ARM, 1) == REJECTED
    assert "no offboard signal" in station.texts()
    station.setpoint(0, 0, 0)
    assert station.command(MODE, 1, OFFBOARD) == ACCEPTED
    station.wait(1.5)
    assert station.pilot.mode is Mode.OFFBOARD  # disarmed: nothing happens
    assert station.command(ARM, 1) == REJECTED  # the stream has dried up
    assert station.command(MODE, 1, 1) == REJECTED  # manual: no sticks
    assert station.command(MODE, 0, OFFBOARD) == DENIED  # no custom mode
    assert station.command(MODE, 1, 99) == ACCEPTED  # there is no such mode: nothing happens
    assert station.pilot.mode is Mode.OFFBOARD


def test_px4_takes_off_when_it_is_armed_if_that_was_asked_for_before() -> None:
    station = Station("px4")
    station.wait(2.0)
    assert station.command(TAKEOFF, *[0.0] * 6, math.nan) == ACCEPTED
    station.wait(1.0)
    assert station.autopilot.vehicle.state()[2] < 0.1
    assert station.command(ARM, 1) == ACCEPTED
    station.wait(5.0)
    assert station.autopilot.vehicle.state()[2] > 2.0
    station.setpoint(0, 0, 0)
    station.wait(2.0)
    assert station.command(MODE, 1, OFFBOARD) == REJECTED  # in the air it wants setpoints


def test_px4_lifts_off_by_an_upward_setpoint() -> None:
    station = Station("px4")
    station.wait(2.0)
    station.setpoint(0, 0, 0)
    station.command(MODE, 1, OFFBOARD)
    assert station.command(ARM, 1) == ACCEPTED
    assert station.fly(0, 0, -1)[2] == pytest.approx(-1.0, abs=0.1)


def test_ardupilot_wants_guided_arming_and_a_takeoff_in_this_order() -> None:
    station = Station("ardupilot")
    station.wait(2.0)
    high = (*[0.0] * 6, 3.0)
    assert station.command(TAKEOFF, *high) == FAILED  # not guided
    station.command(MODE, 1, GUIDED)
    assert station.command(TAKEOFF, *high) == FAILED  # not armed
    station.command(ARM, 1)
    station.fly(0, 0, -1)
    assert station.autopilot.vehicle.state()[2] < 0.1  # a velocity does not lift it
    assert station.command(TAKEOFF, *[0.0] * 7) == FAILED  # to no height
    assert station.command(TAKEOFF, *high) == ACCEPTED
    station.wait(5.0)
    assert station.command(TAKEOFF, *high) == FAILED  # in the air
    assert station.command(MODE, 1, AUTO) == FAILED
    assert station.command(MODE, 1, 99) == UNSUPPORTED
    assert station.command(MODE, 1, 0) == FAILED  # stabilize: no sticks


def test_commands_that_nobody_knows_and_strangers(station: Station) -> None:
    assert station.command(31000) == UNSUPPORTED
    station.heard.clear()
    station.mav.command_long_send(7, 1, ARM, 0, 1, 0, 0, 0, 0, 0, 0)  # another vehicle's
    station.mav.command_long_send(1, 100, ARM, 0, 1, 0, 0, 0, 0, 0, 0)  # its camera's
    assert not station.heard
    station.autopilot.receive(b"\xfd\x03garbage\x00\xfe\xff" * 5)
    for _ in range(20):  # what looked like a frame may swallow a true one
        station.mav.heartbeat_send(6, 8, 0, 0, 4)
    assert station.command(31000) == UNSUPPORTED  # and it still listens


def test_velocities_are_flown_in_ned(flying: Station) -> None:
    for wanted in ((2, 0, 0), (0, 3, 0), (0, 0, -1.5), (-2, 1, 0.5)):
        assert flying.fly(*wanted, seconds=3.0) == pytest.approx(np.array(wanted), abs=0.1)


def test_velocities_are_flown_in_the_body_frame(flying: Station) -> None:
    """It looks east: ahead is east, right is south."""
    assert flying.fly(2, 0, 0, frame=BODY, seconds=3.0) == pytest.approx(np.array([0, 2, 0]), abs=0.1)
    assert flying.fly(0, 2, -1, frame=BODY, seconds=3.0) == pytest.approx(np.array([-2, 0, -1]), abs=0.1)
    flying.fly(0, 0, 0, mask=VELOCITY_YAW, yaw=0.0, seconds=4.0)  # look north
    assert flying.autopilot._heading() == pytest.approx(0.0, abs=0.05)
    assert flying.fly(2, 0, 0, frame=BODY, seconds=3.0) == pytest.approx(np.array([2, 0, 0]), abs=0.15)


def test_a_yaw_rate_turns_clockwise(flying: Station) -> None:
    flying.fly(0, 0, 0, mask=VELOCITY_RATE, rate=0.5, seconds=2.0)
    assert flying.autopilot._heading() == pytest.approx(0.5 * math.pi + 1.0, abs=0.1)


@pytest.mark.parametrize(
    ("frame", "mask", "velocity"),
    [
        (mavlink.MAV_FRAME_GLOBAL, VELOCITY, (1, 0, 0)),
        (mavlink.MAV_FRAME_BODY_FRD, VELOCITY, (1, 0, 0)),
        (LOCAL, 0x0FFF & ~0x200, (1, 0, 0)),  # nothing to fly
        (LOCAL, 0x0C3F, (1, 0, 0)),  # an acceleration
        (LOCAL, 0x0E07, (1, 0, 0)),  # a force
        (LOCAL, VELOCITY | 0x20, (1, 0, 0)),  # two axes of three
        (LOCAL, VELOCITY, (math.nan, 0, 0)),
    ],
)
def test_wrong_frames_and_masks_are_not_flown(
    flying: Station, frame: int, mask: int, velocity: tuple[float, float, float]
) -> None:
    flying.fly(0, 1.5, 0)
    flying.heard.clear()
    reached = flying.fly(*velocity, frame=frame, mask=mask, seconds=6.0)
    assert reached == pytest.approx(np.zeros(3), abs=0.1)  # nothing was heard for long
    if flying.autopilot.rules.name == "px4":
        assert "SET_POSITION_TARGET_LOCAL_NED" in flying.texts()
        assert flying.pilot.mode is Mode.HOLD


def test_only_ardupilot_knows_the_body_offset_frame(flying: Station) -> None:
    reached = flying.fly(2, 0, 0, frame=BODY_OFFSET, seconds=3.0)
    expected = 2.0 if flying.autopilot.rules.name == "ardupilot" else 0.0
    assert reached[1] == pytest.approx(expected, abs=0.1)


def test_setpoints_are_not_flown_in_another_mode() -> None:
    station = Station("px4", airborne=True)
    assert station.fly(2, 0, 0) == pytest.approx(np.zeros(3), abs=0.05)


@pytest.mark.parametrize("timeout", [None, 0.2])
def test_a_stream_that_stops_ends_in_a_hold(flying: Station, timeout: float | None) -> None:
    rules = flying.autopilot.rules
    name, usual = {"px4": ("COM_OF_LOSS_T", 1.0), "ardupilot": ("GUID_TIMEOUT", 3.0)}[rules.name]
    if timeout is not None:
        flying.mav.param_set_send(1, 1, name.encode(), timeout, mavlink.MAV_PARAM_TYPE_REAL32)
    seconds = timeout or usual
    assert flying.fly(0, 3, 0)[1] == pytest.approx(3.0, abs=0.1)
    flying.wait(seconds - 0.12)
    assert flying.autopilot.vehicle.controller.setpoint[0] == pytest.approx(3.0)
    flying.wait(0.2)
    assert flying.autopilot.vehicle.controller.setpoint == (0.0, 0.0, 0.0)
    flying.wait(2.0)
    where = flying.autopilot.vehicle.state()[:3]
    flying.wait(5.0)
    assert flying.autopilot.vehicle.state()[:3] == pytest.approx(where, abs=0.05)
    assert flying.pilot.mode is (Mode.HOLD if rules.name == "px4" else Mode.OFFBOARD)
    assert "Setpoints lost" in flying.texts()


def test_messages_come_at_the_rates_asked_for(station: Station) -> None:
    kind = mavlink.MAVLINK_MSG_ID_LOCAL_POSITION_NED
    assert station.command(511, kind, 40_000) == ACCEPTED
    assert station.command(511, 77_777, 40_000) == FAILED
    station.heard.clear()
    station.wait(2.0)
    stamps = [m.time_boot_ms for m in station.heard if m.get_type() == "LOCAL_POSITION_NED"]
    assert stamps == list(range(40, 2001, 40))
    assert station.command(510, kind) == ACCEPTED
    assert station.last("MESSAGE_INTERVAL").interval_us == 40_000
    assert station.command(511, kind, -1) == ACCEPTED
    station.heard.clear()
    station.wait(1.0)
    assert not [m for m in station.heard if m.get_type() == "LOCAL_POSITION_NED"]
    assert station.command(512, kind) == ACCEPTED
    assert station.last("LOCAL_POSITION_NED")


def test_every_message_can_be_asked_for() -> None:
    lidar = Lidar(field(), task_of(QUADROTOR).rays)
    station = Station("px4", airborne=True, lidar=lidar)
    for name in (
        "ATTITUDE", "ATTITUDE_QUATERNION", "LOCAL_POSITION_NED", "HIGHRES_IMU", "OBSTACLE_DISTANCE", "SYS_STATUS",
        "EXTENDED_SYS_STATE", "GLOBAL_POSITION_INT", "SCALED_IMU", "GPS_RAW_INT", "HOME_POSITION", "BATTERY_STATUS",
        "ODOMETRY", "VFR_HUD", "AUTOPILOT_VERSION",
    ):  # fmt: skip
        assert station.command(512, getattr(mavlink, f"MAVLINK_MSG_ID_{name}")) == ACCEPTED
        assert station.last(name)


def test_telemetry_is_in_ned(flying: Station) -> None:
    flying.fly(1, 2, -0.5, seconds=3.0)
    for name in ("LOCAL_POSITION_NED", "ATTITUDE", "HIGHRES_IMU", "GLOBAL_POSITION_INT"):
        flying.command(512, getattr(mavlink, f"MAVLINK_MSG_ID_{name}"))
        if name == "LOCAL_POSITION_NED":
            m = flying.last(name)
            assert (m.vx, m.vy, m.vz) == pytest.approx((1, 2, -0.5), abs=0.1)
            x, y, z = flying.autopilot.vehicle.state()[:3]
            assert (m.x, m.y, m.z) == pytest.approx((y, x, -z), abs=0.01)
        elif name == "ATTITUDE":
            assert flying.last(name).yaw == pytest.approx(0.5 * math.pi, abs=0.05)
        elif name == "HIGHRES_IMU":
            assert flying.last(name).zacc == pytest.approx(-9.81, abs=0.4)
        else:
            assert flying.last(name).vx == pytest.approx(100, abs=10)


def test_frames_turn_back_and_forth() -> None:
    rng = np.random.default_rng(0)
    for _ in range(20):
        w, x, y, z = (q := rng.standard_normal(4)) / np.linalg.norm(q)
        q, v = (w, x, y, z), tuple(rng.standard_normal(3))
        assert frames.world(frames.world(v)) == pytest.approx(v)
        turned = frames.rotate(frames.attitude(q), frames.body(v))
        assert turned == pytest.approx(frames.world(frames.rotate(q, v)))
        assert frames.into_body(q, frames.rotate(q, v)) == pytest.approx(v)
    assert frames.yaw(frames.yaw(0.3)) == pytest.approx(0.3)


def test_obstacle_distance_is_the_least_of_each_sector() -> None:
    pillar = Obstacle(CYLINDER, (0.0, -4.0, 10.0), (0.5, 20.0))  # to the south: to the right of who looks east
    arena = field(pillar)
    station = Station("px4", airborne=True, arena=arena, lidar=Lidar(arena, task_of(QUADROTOR).rays))
    station.command(512, mavlink.MAVLINK_MSG_ID_OBSTACLE_DISTANCE)
    distances = station.last("OBSTACLE_DISTANCE").distances
    assert len(distances) == BINS
    assert distances[BINS // 4] == pytest.approx(350, abs=2)
    assert distances[0] == distances[BINS // 2] == 1201

    directions = np.array([[1.0, 0.0, 0.0], [np.cos(0.5), 0.0, np.sin(0.5)]])
    assert obstacle_bins(np.array([3.0, 2.0]), directions, 12.0)[0] == math.floor(200 * np.cos(0.5))


def test_parameters_are_listed_read_and_set(station: Station) -> None:
    station.listen()
    station.heard.clear()
    station.mav.param_request_list_send(1, 1)
    table = station.autopilot.rules.parameters.table
    assert [m.param_id for m in station.heard] == [parameter.name for parameter in table]
    station.mav.param_request_read_send(1, 1, b"", 1)
    assert station.last("PARAM_VALUE").param_id == table[1].name
    name = table[2].name if not table[2].integer else table[3].name
    station.mav.param_set_send(1, 1, name.encode(), 2.0, mavlink.MAV_PARAM_TYPE_REAL32)
    assert station.last("PARAM_VALUE").param_value == 2.0
    station.mav.param_set_send(1, 1, name.encode(), -5.0, mavlink.MAV_PARAM_TYPE_REAL32)
    assert station.last("PARAM_VALUE").param_value == 2.0  # out of range: as it was
    station.heard.clear()
    station.mav.param_set_send(1, 1, b"NONSENSE", 1.0, mavlink.MAV_PARAM_TYPE_REAL32)
    assert [m.get_type() for m in station.heard] == ["STATUSTEXT"]


def test_integers_travel_as_bits_in_px4_and_as_values_in_ardupilot() -> None:
    px4, ardupilot = Station("px4"), Station("ardupilot")
    px4.mav.param_request_read_send(1, 1, b"SYS_AUTOSTART", -1)
    assert struct.unpack("<i", struct.pack("<f", px4.last("PARAM_VALUE").param_value))[0] == 4001
    (bits,) = struct.unpack("<f", struct.pack("<i", 4))
    px4.mav.param_set_send(1, 1, b"COM_OBL_RC_ACT", bits, mavlink.MAV_PARAM_TYPE_INT32)
    assert px4.pilot.limits.on_loss is Mode.LAND
    ardupilot.mav.param_request_read_send(1, 1, b"FRAME_CLASS", -1)
    assert ardupilot.last("PARAM_VALUE").param_value == 1.0


def test_lockstep_time_is_the_ticks_time() -> None:
    station = Station("px4", airborne=True)
    station.wait(1.0)
    assert station.pilot.time == pytest.approx(1.0)
    assert round(1.0 / TICK) == 50


def test_unknown_rules_and_parameters_are_refused() -> None:
    with pytest.raises(UnknownRules, match="betaflight"):
        Station("betaflight")
    with pytest.raises(BadParameter):
        Station("px4", parameters={"GUID_TIMEOUT": 1.0})

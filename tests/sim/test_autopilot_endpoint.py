"""The embedded autopilot by both rule sets: commands, setpoints, telemetry, parameters, and a benchmark's requests."""

from __future__ import annotations

import math
import struct

import numpy as np
import pytest

from benchmarks import ground_station, sitl
from benchmarks.autopilot_conformance import on_the_ground
from brakeline.deploy.run.autopilot_run import AutopilotSettings, open_field, vehicle
from brakeline.errors import BadParameter, UnknownName
from brakeline.sim.autopilot.common_dialect import mavlink
from brakeline.sim.autopilot.endpoint import Autopilot
from brakeline.sim.autopilot.flight_modes import LandedState, Mode
from brakeline.sim.autopilot.parameters import AT_ONCE
from brakeline.sim.autopilot.telemetry_sender import MESSAGES
from tests.sim import station as gs
from tests.sim.station import ACCEPTED, ARM, DENIED, FAILED, LAND, MODE, REJECTED, TAKEOFF, UNSUPPORTED, Station


@pytest.fixture(params=["px4", "ardupilot"])
def station(request: pytest.FixtureRequest) -> Station:
    return Station(request.param)


@pytest.fixture(params=["px4", "ardupilot"])
def flying(request: pytest.FixtureRequest) -> Station:
    """Return a station whose vehicle flies and follows setpoints without a limit of acceleration."""
    station = Station(request.param, airborne=True, parameters=AT_ONCE[request.param])
    station.follow_setpoints()
    return station


def test_the_heartbeat_names_the_autopilot_once_a_second(station: Station) -> None:
    station.wait(5.0)
    beats = [m for m in station.received if m.get_type() == "HEARTBEAT"]
    assert len(beats) == 6  # one at once
    assert beats[0].type == mavlink.MAV_TYPE_QUADROTOR
    assert beats[0].autopilot == {"px4": 12, "ardupilot": 3}[station.autopilot.rules.name]
    assert beats[0].get_msgbuf()[0] == 0xFD  # MAVLink 2


def test_the_vehicle_takes_off_lands_and_disarms(station: Station) -> None:
    """Afterwards a PX4 returns to the mode before. An ArduCopter stays in its landing mode, as the real one."""
    rules = station.autopilot.rules
    station.take_off()
    height = station.autopilot.vehicle.state()[2]
    assert height == pytest.approx({"px4": 2.55, "ardupilot": 3.05}[rules.name], abs=0.25)
    assert station.command(ARM, 0) == rules.refusal  # not in the air
    assert station.command(LAND) == ACCEPTED
    station.wait(1.0)
    assert station.flight.landed is LandedState.LANDING and station.flight.mode is Mode.LAND
    station.wait(10.0)
    assert station.flight.landed is LandedState.ON_GROUND and not station.flight.armed
    assert station.flight.mode is {"px4": Mode.OFFBOARD, "ardupilot": Mode.LAND}[rules.name]
    assert not station.autopilot.vehicle.collided
    assert "Landing detected" in station.texts()


def test_arming_is_refused_before_the_estimate_is_ready_and_in_land_mode(station: Station) -> None:
    refusal = station.autopilot.rules.refusal
    assert station.command(ARM, 1) == refusal  # the estimate needs a second
    station.wait(2.0)
    assert station.command(ARM, 0.5) == UNSUPPORTED
    assert station.command(ARM, 1) == ACCEPTED
    assert station.command(ARM, 0) == ACCEPTED
    land = (4, 6) if refusal == REJECTED else (gs.COPTER_LAND,)
    assert station.command(MODE, 1, *land) == ACCEPTED
    assert station.command(ARM, 1) == refusal


def test_an_armed_vehicle_on_the_ground_disarms_after_its_delay(station: Station) -> None:
    station.wait(2.0)
    station.command(ARM, 1)
    station.wait(9.0)
    assert station.flight.armed
    station.wait(2.0)
    assert not station.flight.armed


def test_px4_needs_setpoints_before_offboard() -> None:
    station = Station("px4")
    station.wait(2.0)
    assert station.command(MODE, 1, gs.OFFBOARD) == ACCEPTED  # disarmed: it may be any
    assert station.command(ARM, 1) == REJECTED
    assert "no offboard signal" in station.texts()
    station.setpoint(0, 0, 0)
    assert station.command(MODE, 1, gs.OFFBOARD) == ACCEPTED
    station.wait(1.5)
    assert station.flight.mode is Mode.OFFBOARD  # disarmed: nothing happens
    assert station.command(ARM, 1) == REJECTED  # the setpoints have stopped
    assert station.command(MODE, 1, 1) == REJECTED  # manual: no sticks
    assert station.command(MODE, 0, gs.OFFBOARD) == DENIED  # no custom mode
    assert station.command(MODE, 1, 99) == ACCEPTED  # no such mode: nothing happens
    assert station.flight.mode is Mode.OFFBOARD


@pytest.mark.parametrize("number", [math.nan, math.inf, -math.inf, 3e38])
def test_a_command_about_a_message_without_a_number_is_refused(station: Station, number: float) -> None:
    """Such a command once ended the process of the autopilot."""
    about = mavlink.MAVLINK_MSG_ID_ATTITUDE
    for command in (
        (mavlink.MAV_CMD_SET_MESSAGE_INTERVAL, number, 1e5),
        (mavlink.MAV_CMD_GET_MESSAGE_INTERVAL, number),
        (mavlink.MAV_CMD_REQUEST_MESSAGE, number),
    ):
        assert station.command(*command) in (DENIED, FAILED, UNSUPPORTED)
    if abs(number) != 3e38:
        assert station.command(mavlink.MAV_CMD_SET_MESSAGE_INTERVAL, about, number) == DENIED
    assert station.command(mavlink.MAV_CMD_GET_MESSAGE_INTERVAL, about) == ACCEPTED


def test_px4_takes_off_on_arming_after_a_takeoff_command() -> None:
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
    assert station.command(MODE, 1, gs.OFFBOARD) == REJECTED  # in the air it wants setpoints


def test_px4_lifts_off_by_an_upward_setpoint() -> None:
    station = Station("px4")
    station.wait(2.0)
    station.setpoint(0, 0, 0)
    station.command(MODE, 1, gs.OFFBOARD)
    assert station.command(ARM, 1) == ACCEPTED
    assert station.fly(0, 0, -1)[2] == pytest.approx(-1.0, abs=0.1)


def test_ardupilot_needs_guided_arming_and_takeoff_in_this_order() -> None:
    station = Station("ardupilot")
    station.wait(2.0)
    high = (*[0.0] * 6, 3.0)
    assert station.command(TAKEOFF, *high) == FAILED  # not guided
    station.command(MODE, 1, gs.GUIDED)
    assert station.command(TAKEOFF, *high) == FAILED  # not armed
    station.command(ARM, 1)
    station.fly(0, 0, -1)
    assert station.autopilot.vehicle.state()[2] < 0.1  # a velocity does not lift the vehicle off
    assert station.command(TAKEOFF, *[0.0] * 7) == FAILED  # to no height
    assert station.command(TAKEOFF, *high) == ACCEPTED
    station.wait(5.0)
    assert station.command(TAKEOFF, *high) == FAILED  # in the air
    assert station.command(MODE, 1, gs.AUTO) == FAILED
    assert station.command(MODE, 1, 99) == UNSUPPORTED
    assert station.command(MODE, 1, 0) == FAILED  # stabilize: no sticks


def test_unknown_commands_and_messages_to_others_have_no_effect(station: Station) -> None:
    assert station.command(31000) == UNSUPPORTED
    station.received.clear()
    station.mav.command_long_send(7, 1, ARM, 0, 1, 0, 0, 0, 0, 0, 0)  # to another vehicle
    station.mav.command_long_send(1, 100, ARM, 0, 1, 0, 0, 0, 0, 0, 0)  # to a camera
    assert not station.received
    station.autopilot.receive(b"\xfd\x03garbage\x00\xfe\xff" * 5)
    for _ in range(20):  # garbage that looks like a frame can swallow a real one
        station.mav.heartbeat_send(6, 8, 0, 0, 4)
    assert station.command(31000) == UNSUPPORTED  # the autopilot still receives


def test_the_vehicle_follows_velocities_in_ned(flying: Station) -> None:
    for wanted in ((2, 0, 0), (0, 3, 0), (0, 0, -1.5), (-2, 1, 0.5)):
        assert flying.fly(*wanted, seconds=3.0) == pytest.approx(np.array(wanted), abs=0.1)


def test_the_vehicle_follows_velocities_in_the_body_frame(flying: Station) -> None:
    """The vehicle faces east: ahead is east, right is south."""
    assert flying.fly(2, 0, 0, frame=gs.BODY, seconds=3.0) == pytest.approx(np.array([0, 2, 0]), abs=0.1)
    assert flying.fly(0, 2, -1, frame=gs.BODY, seconds=3.0) == pytest.approx(np.array([-2, 0, -1]), abs=0.1)
    offset = flying.fly(2, 0, 0, frame=gs.BODY_OFFSET, seconds=3.0)  # only ArduPilot supports it
    assert offset[1] == pytest.approx(2.0 if flying.autopilot.rules.name == "ardupilot" else 0.0, abs=0.1)
    flying.fly(0, 0, 0, mask=gs.VELOCITY_YAW, yaw=0.0, seconds=4.0)  # turn to the north
    assert flying.autopilot.telemetry.heading() == pytest.approx(0.0, abs=0.05)
    assert flying.fly(2, 0, 0, frame=gs.BODY, seconds=3.0) == pytest.approx(np.array([2, 0, 0]), abs=0.15)
    flying.fly(0, 0, 0, mask=gs.VELOCITY_RATE, rate=0.5, seconds=2.0)  # a positive yaw rate turns clockwise
    assert flying.autopilot.telemetry.heading() == pytest.approx(1.0, abs=0.1)


def test_setpoints_with_a_wrong_frame_or_mask_are_ignored(flying: Station) -> None:
    for frame, mask, speed in (
        (mavlink.MAV_FRAME_GLOBAL, gs.VELOCITY, 1.0),
        (mavlink.MAV_FRAME_BODY_FRD, gs.VELOCITY, 1.0),
        (gs.LOCAL, 0x0FFF & ~0x200, 1.0),  # nothing to fly
        (gs.LOCAL, 0x0C3F, 1.0),  # an acceleration
        (gs.LOCAL, 0x0E07, 1.0),  # a force
        (gs.LOCAL, gs.VELOCITY | 0x20, 1.0),  # two axes of three
        (gs.LOCAL, gs.VELOCITY, math.nan),
    ):
        assert flying.fly(0, 1.5, 0)[1] == pytest.approx(1.5, abs=0.1) and flying.flight.mode is Mode.OFFBOARD
        flying.received.clear()
        reached = flying.fly(speed, 0, 0, frame=frame, mask=mask, seconds=6.0)
        assert reached == pytest.approx(np.zeros(3), abs=0.1)  # no valid setpoint came within the timeout
        if flying.autopilot.rules.name == "px4":
            assert "SET_POSITION_TARGET_LOCAL_NED" in flying.texts()
            assert flying.flight.mode is Mode.POSITION


def test_setpoints_in_another_mode_have_no_effect() -> None:
    station = Station("px4", airborne=True)
    assert station.fly(2, 0, 0) == pytest.approx(np.zeros(3), abs=0.05)


@pytest.mark.parametrize(("acceleration", "speed", "way"), [(None, 1.0, 4.5), (500.0, 2.9, 0.9)])
def test_an_arducopter_follows_setpoints_with_its_acceleration(
    acceleration: float | None, speed: float, way: float
) -> None:
    """With the default parameters it takes seconds to follow a setpoint, and as long to stop, as a real ArduCopter."""
    parameters = {} if acceleration is None else {"WPNAV_ACCEL": acceleration}
    station = Station("ardupilot", airborne=True, parameters=parameters)
    station.follow_setpoints()
    station.fly(0, 3, 0, seconds=1.0)
    assert station.autopilot.vehicle.controller.setpoint[0] == pytest.approx(speed, abs=0.15)
    station.fly(0, 3, 0, seconds=4.0)
    began = station.autopilot.vehicle.state()[0]
    station.fly(0, 0, 0, seconds=6.0)
    went = station.autopilot.vehicle.state()[0] - began
    assert way < went < way + 1.2


@pytest.mark.parametrize("timeout", [None, 0.2])
def test_the_vehicle_holds_after_its_setpoints_stop(flying: Station, timeout: float | None) -> None:
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
    assert flying.flight.mode is (Mode.POSITION if rules.name == "px4" else Mode.OFFBOARD)
    assert "Setpoints lost" in flying.texts()


@pytest.mark.parametrize(("action", "mode"), [(0, Mode.POSITION), (4, Mode.LAND), (5, Mode.HOLD)])
def test_a_parameter_of_px4_sets_the_mode_after_lost_setpoints(action: float, mode: Mode) -> None:
    station = Station("px4", airborne=True, parameters={"COM_OBL_RC_ACT": action})
    station.follow_setpoints()
    station.fly(0, 1, 0)
    station.wait(1.5)
    assert station.flight.mode is mode


def test_setpoints_take_effect_again_after_a_loss_unless_another_mode_was_chosen(flying: Station) -> None:
    """As with a real PX4, a pause of the sender does not end the flight."""
    flying.fly(0, 3, 0)
    flying.wait(4.1)
    assert flying.flight.setpoint.velocity == (0.0, 0.0, 0.0)
    assert flying.fly(0, 3, 0)[1] == pytest.approx(3.0, abs=0.1) and flying.flight.mode is Mode.OFFBOARD
    flying.wait(4.0)
    flying.flight.change(Mode.HOLD)
    assert flying.fly(0, 3, 0) == pytest.approx(np.zeros(3), abs=0.1) and flying.flight.mode is Mode.HOLD


def test_messages_have_the_requested_rates(station: Station) -> None:
    kind = mavlink.MAVLINK_MSG_ID_LOCAL_POSITION_NED
    assert station.command(511, kind, 40_000) == ACCEPTED
    assert station.command(511, 77_777, 40_000) == FAILED
    station.received.clear()
    station.wait(2.0)
    stamps = [m.time_boot_ms for m in station.received if m.get_type() == "LOCAL_POSITION_NED"]
    assert stamps == list(range(40, 2001, 40))
    assert station.command(510, kind) == ACCEPTED
    assert station.last("MESSAGE_INTERVAL").interval_us == 40_000
    assert station.command(511, kind, -1) == ACCEPTED
    station.received.clear()
    station.wait(1.0)
    assert not [m for m in station.received if m.get_type() == "LOCAL_POSITION_NED"]
    assert station.command(512, kind) == ACCEPTED
    assert station.last("LOCAL_POSITION_NED")


def test_every_message_can_be_requested() -> None:
    station = Station("px4", airborne=True)
    for kind, name in MESSAGES.items():
        assert station.command(512, kind) == ACCEPTED
        assert station.last(name.upper())


def test_arducopter_refuses_unsupported_messages() -> None:
    """ArduCopter 4.0 refuses these messages."""
    station = Station("ardupilot", airborne=True)
    for name in ("ATTITUDE_QUATERNION", "HIGHRES_IMU", "ODOMETRY"):
        kind = getattr(mavlink, f"MAVLINK_MSG_ID_{name}")
        assert station.command(511, kind, 40_000) == FAILED
        assert station.command(512, kind) == UNSUPPORTED
        assert station.command(510, kind) != ACCEPTED
    station.received.clear()
    station.mav.request_data_stream_send(1, 1, mavlink.MAV_DATA_STREAM_ALL, 10, 1)
    station.wait(1.0)
    names = {message.get_type() for message in station.received}
    assert {"SCALED_IMU", "ATTITUDE"} < names and not names & {"ATTITUDE_QUATERNION", "HIGHRES_IMU", "ODOMETRY"}


def test_telemetry_is_in_ned(flying: Station) -> None:
    flying.fly(1, 2, -0.5, seconds=3.0)
    force, unit = {"px4": ("HIGHRES_IMU", 1.0), "ardupilot": ("SCALED_IMU", 9.80665e-3)}[flying.autopilot.rules.name]
    for name in ("LOCAL_POSITION_NED", "ATTITUDE", force, "GLOBAL_POSITION_INT"):
        flying.command(512, getattr(mavlink, f"MAVLINK_MSG_ID_{name}"))
        if name == "LOCAL_POSITION_NED":
            m = flying.last(name)
            assert (m.vx, m.vy, m.vz) == pytest.approx((1, 2, -0.5), abs=0.1)
            x, y, z = flying.autopilot.vehicle.state()[:3]
            assert (m.x, m.y, m.z) == pytest.approx((y, x, -z), abs=0.01)
        elif name == "ATTITUDE":
            assert flying.last(name).yaw == pytest.approx(0.5 * math.pi, abs=0.05)
        elif name == force:
            assert unit * flying.last(name).zacc == pytest.approx(-9.81, abs=0.4)
        else:
            assert flying.last(name).vx == pytest.approx(100, abs=10)


def test_parameters_are_listed_read_and_set(station: Station) -> None:
    station.listen()
    station.received.clear()
    station.mav.param_request_list_send(1, 1)
    table = station.autopilot.parameters.table
    assert [m.param_id for m in station.received] == [parameter.name for parameter in table]
    station.mav.param_request_read_send(1, 1, b"", 1)
    assert station.last("PARAM_VALUE").param_id == table[1].name
    name = table[2].name if not table[2].integer else table[3].name
    station.mav.param_set_send(1, 1, name.encode(), 2.0, mavlink.MAV_PARAM_TYPE_REAL32)
    assert station.last("PARAM_VALUE").param_value == 2.0
    station.mav.param_set_send(1, 1, name.encode(), -5.0, mavlink.MAV_PARAM_TYPE_REAL32)
    assert station.last("PARAM_VALUE").param_value == 2.0  # out of range: unchanged
    station.received.clear()
    station.mav.param_set_send(1, 1, b"NONSENSE", 1.0, mavlink.MAV_PARAM_TYPE_REAL32)
    assert [m.get_type() for m in station.received] == ["STATUSTEXT"]


def test_integers_travel_as_bits_in_px4_and_as_values_in_ardupilot() -> None:
    px4, ardupilot = Station("px4"), Station("ardupilot")
    px4.mav.param_request_read_send(1, 1, b"SYS_AUTOSTART", -1)
    assert struct.unpack("<i", struct.pack("<f", px4.last("PARAM_VALUE").param_value))[0] == 4001
    (bits,) = struct.unpack("<f", struct.pack("<i", 4))
    px4.mav.param_set_send(1, 1, b"COM_OBL_RC_ACT", bits, mavlink.MAV_PARAM_TYPE_INT32)
    assert px4.flight.limits.on_loss is Mode.LAND
    ardupilot.mav.param_request_read_send(1, 1, b"FRAME_CLASS", -1)
    assert ardupilot.last("PARAM_VALUE").param_value == 1.0


def test_unknown_rules_and_parameters_are_refused() -> None:
    with pytest.raises(UnknownName, match="betaflight"):
        Station("betaflight")
    with pytest.raises(BadParameter):
        Station("px4", parameters={"GUID_TIMEOUT": 1.0})


class SimulatedLink:
    """A link to an autopilot in this process, and the clock of that autopilot."""

    def __init__(self, autopilot: Autopilot) -> None:
        self.send, self.receive, self.sleep = autopilot.receive, autopilot.take, autopilot.advance
        self.monotonic = lambda: autopilot.flight.time


def test_an_embedded_one_answers_on_the_ground(monkeypatch: pytest.MonkeyPatch) -> None:
    link = SimulatedLink(vehicle(AutopilotSettings("", "ardupilot"), open_field(), 1))
    for module in ("ground_station", "autopilot_conformance"):
        monkeypatch.setattr(f"benchmarks.{module}.time", link)
    answers = on_the_ground(ground_station.Station(link, 1), "ardupilot")  # type: ignore[arg-type]
    assert (answers["arm, armed already"], answers["disarm"]) == ("accepted", "accepted")
    assert answers["LOCAL_POSITION_NED at 20 Hz"] == "accepted, comes"
    assert answers["ODOMETRY at 20 Hz"] == "failed, does not come"
    assert answers["interval of message 9999"] == "failed" and answers["command USER_1"] == "unsupported"
    assert (answers["mode 99"], answers["mode after mode 99"]) == ("unsupported", 0)
    assert (answers["take off, disarmed"], answers["mode after that"]) == ("failed", 4)


@pytest.mark.parametrize(("at_once", "acceleration"), [(False, 1.0), (True, 1e4)])
def test_an_arducopter_of_ours_is_as_delivered_or_as_it_was_recorded(at_once: bool, acceleration: float) -> None:
    """`fly` needs the vehicle of the recorded data, which follows setpoints at once."""
    settings = AutopilotSettings("", "ardupilot", airborne=True, at_once=at_once, setpoint_timeout=0.2)
    autopilot = vehicle(settings, open_field(), 1)
    assert autopilot.flight.limits.horizontal_acceleration == acceleration
    assert autopilot.flight.limits.vertical_acceleration == acceleration
    assert autopilot.flight.limits.setpoint_timeout == 0.2


def test_where_there_is_no_real_one_the_variable_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("BRAKELINE_PX4", raising=False)
    with pytest.raises(sitl.NoAutopilot, match="BRAKELINE_PX4"):
        sitl.program("px4")

"""Telemetry of the embedded autopilot has its rates, units and frames; parameters can be read and set."""

from __future__ import annotations

import math
import struct

import numpy as np
import pytest

from brakeline.errors import BadParameter, UnknownName
from brakeline.sim.autopilot import ned_frames
from brakeline.sim.autopilot.common_dialect import mavlink
from brakeline.sim.autopilot.flight_modes import Mode
from brakeline.sim.autopilot.telemetry_sender import MESSAGES
from tests.sim.station import ACCEPTED, FAILED, UNSUPPORTED, Station


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


def test_frame_conversions_are_inverse_to_each_other() -> None:
    rng = np.random.default_rng(0)
    for _ in range(20):
        w, x, y, z = (q := rng.standard_normal(4)) / np.linalg.norm(q)
        q, v = (w, x, y, z), tuple(rng.standard_normal(3))
        assert ned_frames.world(ned_frames.world(v)) == pytest.approx(v)
        turned = ned_frames.rotate(ned_frames.attitude(q), ned_frames.body(v))
        assert turned == pytest.approx(ned_frames.world(ned_frames.rotate(q, v)))
        assert ned_frames.into_body(q, ned_frames.rotate(q, v)) == pytest.approx(v)
    assert ned_frames.yaw(ned_frames.yaw(0.3)) == pytest.approx(0.3)


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

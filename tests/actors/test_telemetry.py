"""Units and frames of every message, the choice of messages that an autopilot grants and sends, and positions instead
of velocities, which the position controller turns into the wanted velocity.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from brakeline.actors.actor_settings import FlightSettings
from brakeline.actors.mavlink.ardupilot_dialect import mavlink
from brakeline.actors.mavlink.autopilot_commands import AutopilotClient, message_id
from brakeline.actors.mavlink.autopilot_limits import AUTOPILOT_LIMITS, demand, limits_below_demand, limits_beyond_top
from brakeline.actors.mavlink.position_lookahead import LATENCY, PARAMETERS, AxisLookahead, PositionLookahead
from brakeline.actors.mavlink.takeoff import Takeoff
from brakeline.actors.mavlink.telemetry import (
    ATTITUDE,
    ESTIMATED,
    FORCE,
    LANDED,
    MOTION,
    SOURCES,
    TRUTH,
    GeoPosition,
    mode_name,
    rotate,
    unknown_quantities,
)
from brakeline.errors import MavlinkError, TelemetryMissing
from tests.robots import QUADROTOR

ROLL, PITCH, YAW = 0.2, -0.3, 1.1  # rad
DOWN = -1.02  # g, the reading along the vertical axis of a vehicle that hovers
KINDS = {"px4": mavlink.MAV_AUTOPILOT_PX4, "ardupilot": mavlink.MAV_AUTOPILOT_ARDUPILOTMEGA}


def quaternion() -> tuple[float, ...]:
    """Return the attitude (w, x, y, z): turned about down, then right, then forward."""
    return tuple(Rotation.from_euler("ZYX", (YAW, PITCH, ROLL)).as_quat(scalar_first=True).tolist())


def odometry(frame: int = 1, child: int = 1, velocity: tuple[float, float, float] = (4.0, 5.0, 6.0)) -> Any:
    nothing = [math.nan] + [0.0] * 20
    return mavlink.MAVLink_odometry_message(
        12_500_000, frame, child, 1.0, 2.0, 3.0, quaternion(), *velocity, 0, 0, 0, nothing, nothing
    )


MESSAGES: dict[str, Any] = {
    "LOCAL_POSITION_NED": mavlink.MAVLink_local_position_ned_message(12_500, 1.0, 2.0, 3.0, 4.0, 5.0, 6.0),
    "ODOMETRY": odometry(),
    "ATTITUDE_QUATERNION": mavlink.MAVLink_attitude_quaternion_message(0, *quaternion(), 0, 0, 0),
    "ATTITUDE": mavlink.MAVLink_attitude_message(0, ROLL, PITCH, YAW, 0, 0, 0),
    "HIGHRES_IMU": mavlink.MAVLink_highres_imu_message(0, 0.1, 0.2, 9.80665 * DOWN, *[0] * 10, 0),
    "SCALED_IMU": mavlink.MAVLink_scaled_imu_message(0, 10, 20, -1020, *[0] * 6),
    "RAW_IMU": mavlink.MAVLink_raw_imu_message(0, 10, 20, -1020, *[0] * 6),
    "SCALED_IMU2": mavlink.MAVLink_scaled_imu2_message(0, 10, 20, -1020, *[0] * 6),
    "SIMSTATE": mavlink.MAVLink_simstate_message(*[0] * 9, 473977420, 85455940),
    "HIL_STATE_QUATERNION": mavlink.MAVLink_hil_state_quaternion_message(
        0, (1, 0, 0, 0), 0, 0, 0, 473977420, 85455940, 488_500, *[0] * 8
    ),
    "EXTENDED_SYS_STATE": mavlink.MAVLink_extended_sys_state_message(0, mavlink.MAV_LANDED_STATE_IN_AIR),
}


def position_at(now: float) -> Any:
    """Return a position with a time [s], since one that is not newer than the last one does not count."""
    return mavlink.MAVLink_local_position_ned_message(round(1e3 * now), 1.0, 2.0, 3.0, 0.0, 0.0, 0.0)


@pytest.mark.parametrize(("what", "name"), [(what, s.message) for what in SOURCES for s in SOURCES[what]])
def test_every_message_of_a_quantity_gives_the_same_value(what: str, name: str) -> None:
    read = next(source.read for source in SOURCES[what] if source.message == name)
    value = read(MESSAGES[name])
    if what == MOTION:
        assert value.time == pytest.approx(12.5)
        assert value.position == pytest.approx([2.0, 1.0, -3.0]) and value.velocity == pytest.approx([5.0, 4.0, -6.0])
    elif what == ATTITUDE:
        assert value == pytest.approx(quaternion(), abs=1e-6)
    elif what == TRUTH:
        north = GeoPosition(value.latitude + 9000, value.longitude, value.altitude, value.metres).since(value)
        east = GeoPosition(value.latitude, value.longitude + 9000, value.altitude, value.metres).since(value)
        assert north == pytest.approx([0.0, 100.0, 0.0], abs=0.3), "an Earth's quarter is 10,000 km"
        assert east == pytest.approx([100.0 * math.cos(math.radians(47.4)), 0.0, 0.0], abs=0.3)
        assert value.altitude in (None, 488.5)
    elif what == FORCE:
        assert value == pytest.approx([0.1, 0.2, 9.80665 * DOWN], abs=0.005)
    else:
        assert value is True


def test_body_frame_odometry_is_rotated_and_an_unknown_frame_ignored() -> None:
    read = SOURCES[MOTION][1].read
    ahead = read(odometry(child=12, velocity=(1.0, 0.0, 0.0))).velocity
    level = math.cos(PITCH)
    assert ahead == pytest.approx([level * math.sin(YAW), level * math.cos(YAW), math.sin(PITCH)], abs=1e-6)
    assert read(odometry(frame=20)) is None and SOURCES[ATTITUDE][1].read(odometry(frame=20)) is None


@pytest.mark.parametrize("q", [(0.0, 0.0, 0.0, 0.0), (0.5, 0.0, 0.0, 0.0), (math.nan, 0.0, 0.0, 0.0)])
def test_a_quaternion_that_is_no_rotation_is_no_attitude(q: tuple[float, ...]) -> None:
    """Zeros counted as a level vehicle that faces north: its body's velocity got a wrong direction."""
    lost = odometry(child=12)
    lost.q = list(q)
    attitude = mavlink.MAVLink_attitude_quaternion_message(0, *q, 0, 0, 0)
    assert SOURCES[MOTION][1].read(lost) is None
    assert SOURCES[ATTITUDE][0].read(attitude) is None and SOURCES[ATTITUDE][1].read(lost) is None


class ScriptedAutopilot:
    """An autopilot with scripted replies and a clock of its own.

    grants: the rate [Hz] at which each granted message arrives; it refuses all others.
    """

    def __init__(self, kind: str, grants: dict[str, float], parameters: dict[str, float] | None = None) -> None:
        self.grants, self.parameters, self.now = grants, parameters or {}, 0.0
        self.client, self.switched_off = AutopilotClient(self.receive), list[str]()
        self._out = bytearray()
        self._mav = mavlink.MAVLink(self, srcSystem=1, srcComponent=1)
        self._asked: dict[str, float] = {}
        self._mav.heartbeat_send(mavlink.MAV_TYPE_QUADROTOR, KINDS[kind], 1, 0, mavlink.MAV_STATE_ACTIVE)

    def write(self, data: bytes) -> None:
        self._out += data

    def receive(self, data: bytes) -> None:
        for message in mavlink.MAVLink(None).parse_buffer(data) or ():
            if message.get_type() == "COMMAND_LONG" and message.command == mavlink.MAV_CMD_SET_MESSAGE_INTERVAL:
                name = mavlink.mavlink_map[int(message.param1)].msgname
                if message.param2 < 0:
                    self.switched_off.append(name)
                    self._asked.pop(name, None)
                elif name in self.grants:
                    self._asked[name] = self.now
                self._mav.command_ack_send(message.command, 0 if name in self.grants else 4)
            if message.get_type() == "PARAM_REQUEST_READ" and message.param_id in self.parameters:
                value = self.parameters[message.param_id]
                self._mav.param_value_send(message.param_id.encode(), value, mavlink.MAV_PARAM_TYPE_REAL32, 1, 0)

    def wait(self, condition: Callable[[], bool], seconds: float) -> bool:
        end = self.now + seconds
        while True:
            self.client.feed(bytes(self._out))
            self._out.clear()
            if condition():
                return True
            if self.now >= end - 1e-9:
                return False
            self.now += 0.01
            for name, since in self._asked.items():
                rate = self.grants[name]
                if rate and int((self.now - since) * rate) > int((self.now - 0.01 - since) * rate):
                    self._mav.send(position_at(self.now) if name == "LOCAL_POSITION_NED" else MESSAGES[name])


def test_a_breach_of_the_geofence_is_decoded() -> None:
    client, mav = AutopilotClient(lambda _: None), mavlink.MAVLink(None, srcSystem=1, srcComponent=1)
    for breach, side in ((1, 2), (1, 3), (1, 0), (0, 3)):
        client.feed(mavlink.MAVLink_fence_status_message(breach, 1, side, 1000).pack(mav))
        expected = {2: "greatest altitude", 3: "boundary", 0: "geofence"}[side] if breach else ""
        assert client.breached_side == expected


@pytest.mark.parametrize(
    "message",
    [
        mavlink.MAVLink_local_position_ned_message(1000, math.nan, 0, 0, 0, 0, 0),
        mavlink.MAVLink_attitude_message(1000, math.inf, 0, 0, 0, 0, 0),
        mavlink.MAVLink_highres_imu_message(0, math.nan, 0, 0, *[0] * 10, 0),
    ],
)
def test_a_message_with_nan_does_not_count_as_fresh(message: Any) -> None:
    """Such a message once counted as fresh, and ended a flight with a virtual scan in an exception."""
    client, mav = AutopilotClient(lambda _: None), mavlink.MAVLink(None, srcSystem=1, srcComponent=1)
    client.feed(mavlink.MAVLink_heartbeat_message(2, KINDS["px4"], 128, 0, 4, 3).pack(mav))
    before = dict(client.message_counts)
    client.feed(message.pack(mav))
    assert dict(client.message_counts) == before


def test_a_message_that_is_granted_but_never_arrives_is_not_used() -> None:
    """PX4 does this before it knows its heading."""
    autopilot = ScriptedAutopilot("px4", {"ATTITUDE_QUATERNION": 0.0, "ODOMETRY": 50.0, "HIGHRES_IMU": 50.0})
    line = autopilot.client.choose(ATTITUDE, 0.02, autopilot.wait)
    assert line.startswith("attitude from ODOMETRY at 5") and "QUATERNION is granted, but never arrives" in line
    assert autopilot.switched_off == ["ATTITUDE_QUATERNION"]
    autopilot.client.choose(FORCE, 0.02, autopilot.wait)
    north, east, down = rotate(quaternion(), (0.1, 0.2, 9.80665 * DOWN))
    assert autopilot.client.acceleration == pytest.approx([east, north, -down - 9.81], abs=1e-4)


def test_a_refused_message_is_replaced_as_arducopter_needs_it() -> None:
    grants = ("ATTITUDE", "RAW_IMU", "EXTENDED_SYS_STATE", "LOCAL_POSITION_NED")
    autopilot = ScriptedAutopilot("ardupilot", dict.fromkeys(grants, 50.0))
    lines = [autopilot.client.choose(what, 0.02, autopilot.wait) for what in (ATTITUDE, FORCE, LANDED, MOTION)]
    assert list(autopilot.client.chosen.values()) == list(grants), lines
    assert autopilot.client.airborne and autopilot.client.position == pytest.approx([2.0, 1.0, -3.0])


def test_a_vehicle_does_not_take_off_if_a_second_one_has_its_id() -> None:
    grants = ("ATTITUDE", "RAW_IMU", "EXTENDED_SYS_STATE", "LOCAL_POSITION_NED")
    autopilot = ScriptedAutopilot("ardupilot", dict.fromkeys(grants, 50.0))
    autopilot.client.second_source = "10.0.0.2:14550"
    setpoints: list[object] = []
    takeoff = Takeoff(autopilot.client, QUADROTOR, FlightSettings(""), autopilot.wait, setpoints.append, str)
    with pytest.raises(MavlinkError, match=r"vehicle 1 is at .*also come from 10\.0\.0\.2:14550"):
        takeoff.fly()
    assert not setpoints and not autopilot.client.armed


def test_raw_imu_is_used_only_for_ardupilot() -> None:
    autopilot = ScriptedAutopilot("px4", {"RAW_IMU": 50.0})
    with pytest.raises(TelemetryMissing, match="HIGHRES_IMU is refused"):
        autopilot.client.choose(FORCE, 0.02, autopilot.wait)


def test_the_faster_of_two_slow_messages_is_used_unless_it_is_too_slow_to_fly() -> None:
    autopilot = ScriptedAutopilot("px4", {"ATTITUDE_QUATERNION": 4.0, "ATTITUDE": 20.0})
    assert autopilot.client.choose(ATTITUDE, 0.02, autopilot.wait).startswith("attitude from ATTITUDE at 2")
    autopilot = ScriptedAutopilot("px4", {"ATTITUDE_QUATERNION": 4.0})
    with pytest.raises(TelemetryMissing, match="arrives at 4 Hz"):
        autopilot.client.choose(ATTITUDE, 0.02, autopilot.wait)


def test_after_the_choice_other_messages_of_the_quantity_are_ignored() -> None:
    autopilot = ScriptedAutopilot("px4", {"ATTITUDE_QUATERNION": 0.0, "ATTITUDE": 50.0})
    autopilot.client.choose(ATTITUDE, 0.02, autopilot.wait)
    count = autopilot.client.message_counts[ATTITUDE]
    autopilot._mav.send(MESSAGES["ATTITUDE_QUATERNION"])
    autopilot.wait(lambda: False, 0.0)
    assert autopilot.client.message_counts[ATTITUDE] == count


def test_parameters_below_the_robots_bounds_are_found() -> None:
    autopilot = ScriptedAutopilot("ardupilot", {}, {"WPNAV_ACCEL": 100.0, "WPNAV_SPEED": 800.0})
    autopilot.client.identify(autopilot.wait)
    names = [limit.parameter for limit in AUTOPILOT_LIMITS["ardupilot"]]
    known = {n: value for n in names if (value := autopilot.client.parameter(n, autopilot.wait)) is not None}
    assert known == {"WPNAV_ACCEL": 100.0, "WPNAV_SPEED": 800.0}
    below = limits_below_demand("ardupilot", known, QUADROTOR)
    assert [(limit.parameter, value) for limit, value, _ in below] == [("WPNAV_ACCEL", 100.0)]
    demands = demand(QUADROTOR)
    assert (demands["speed"], demands["climb"], demands["acceleration"]) == pytest.approx((50**0.5, 5.0, 32**0.5))
    assert below[0][2] == 500.0, "the largest value that the parameter takes"
    raised = known | {"WPNAV_ACCEL": 500.0}
    assert limits_below_demand("ardupilot", raised, QUADROTOR) == []
    beyond = limits_beyond_top("ardupilot", raised, QUADROTOR)
    assert [(limit.parameter, needed) for limit, needed in beyond] == [("WPNAV_ACCEL", 565.7)]
    assert limits_beyond_top("px4", {"MPC_XY_VEL_MAX": 12.0, "MPC_TILTMAX_AIR": 45.0}, QUADROTOR) == []


def test_missing_quantities_of_the_estimator_have_names() -> None:
    assert unknown_quantities(sum({1, 2, 4, 16, 32})) == [] and unknown_quantities(sum({1, 2, 4, 8, 32})) == []
    still = "anything except that the vehicle stands still"
    assert unknown_quantities(165) == ["horizontal velocity", "horizontal position", still]
    assert unknown_quantities(0) == list(ESTIMATED)


def test_modes_have_names() -> None:
    assert mode_name("ardupilot", 6) == "RTL" and mode_name("ardupilot", 99) == "mode 99"
    assert mode_name("px4", 6 << 16) == "OFFBOARD" and mode_name("px4", 4 << 16 | 5 << 24) == "RETURN"
    assert message_id("EXTENDED_SYS_STATE") == 245


VALUES = {
    "ardupilot": dict(zip(PARAMETERS["ardupilot"], (2.0, 1.0, 500.0, 300.0), strict=True)),
    "px4": {"MPC_XY_P": 2.0, "MPC_Z_P": 1.0},
}


def controller_speed(error: float, gain: float, acceleration: float) -> float:
    """Return the velocity [m/s] that ArduPilot's `sqrt_controller` asks for at a position error [m]."""
    linear = acceleration / gain**2
    if abs(error) <= linear:
        return gain * error
    return math.copysign(math.sqrt(2.0 * acceleration * (abs(error) - 0.5 * linear)), error)


@given(st.floats(0.0, 20.0), st.floats(0.5, 3.0), st.floats(0.5, 9.0))
def test_the_lookahead_distance_gives_the_wanted_speed(speed: float, gain: float, acceleration: float) -> None:
    distance = AxisLookahead(gain, acceleration).distance(speed)
    assert controller_speed(distance, gain, acceleration) == pytest.approx(speed, abs=1e-9)


@pytest.mark.parametrize(("kind", "brakes"), [("ardupilot", (5.0, 3.0)), ("px4", (math.inf, math.inf))])
@given(wanted=st.tuples(*[st.floats(-5.0, 5.0)] * 3))
def test_the_position_lies_in_the_direction_of_the_velocity(
    kind: str, brakes: tuple[float, float], wanted: tuple[float, float, float]
) -> None:
    position, velocity = np.array([3.0, -2.0, 7.0]), np.array([1.0, 2.0, -0.5])
    target = PositionLookahead.of(kind, VALUES[kind]).target(position, velocity, np.array(wanted))
    ahead = target - position - LATENCY * velocity
    level = math.hypot(*wanted[:2])
    speed = controller_speed(math.hypot(*ahead[:2]), 2.0, brakes[0])
    assert speed == pytest.approx(level, abs=1e-6)
    assert ahead[:2] * level == pytest.approx(np.array(wanted[:2]) * math.hypot(*ahead[:2]), abs=1e-6)
    assert controller_speed(ahead[2], 1.0, brakes[1]) == pytest.approx(wanted[2], abs=1e-6)


@pytest.mark.parametrize(("kind", "name"), [(kind, name) for kind, names in PARAMETERS.items() for name in names])
@pytest.mark.parametrize("value", [0.0, -1.0, math.nan, math.inf])
def test_an_invalid_parameter_is_named(kind: str, name: str, value: float) -> None:
    with pytest.raises(ValueError, match=f"{name} is {value:g}"):
        PositionLookahead.of(kind, VALUES[kind] | {name: value})


def test_velocities_are_sent_until_the_position_is_known_and_then_positions() -> None:
    sent: list[bytes] = []
    client = AutopilotClient(sent.append)
    client.lookahead = PositionLookahead.of("ardupilot", VALUES["ardupilot"])
    client.setpoint(np.array([1.0, 0.0, 0.0]))
    client.message_counts[MOTION] += 1
    client.position, client.velocity = np.array([10.0, 20.0, 30.0]), np.zeros(3)
    client.setpoint(np.array([1.0, 0.0, 2.0]))
    fast, place = mavlink.MAVLink(None).parse_buffer(b"".join(sent))
    ignored = {"x": 1, "y": 2, "z": 4, "vx": 8, "vy": 16, "vz": 32, "yaw": 1024, "yaw_rate": 2048}
    assert (fast.vx, fast.vy, fast.vz) == (0.0, 1.0, 0.0) and all(fast.type_mask & ignored[axis] for axis in "xyz")
    assert (place.x, place.y, place.z) == (20.0, 10.5, -32.0) and not any(place.type_mask & ignored[a] for a in "xyz")
    assert (place.vx, place.vy, place.vz) == (0.0, 0.0, 0.0) and not place.type_mask & ignored["vx"]
    assert place.type_mask & ignored["yaw"] and place.type_mask & ignored["yaw_rate"]


@pytest.mark.parametrize("kind", PARAMETERS)
def test_positions_need_the_parameters_of_the_controller(kind: str) -> None:
    client = AutopilotClient(lambda data: None)
    wait = lambda condition, seconds: condition()  # noqa: E731
    client.kind = kind
    with pytest.raises(MavlinkError, match=f"the autopilot has no {', '.join(PARAMETERS[kind])}: fly it by velocities"):
        client.lead(wait)
    assert client.lookahead is None

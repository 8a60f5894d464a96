"""Places in place of velocities: what ArduPilot's position controller makes of them is the velocity that was wanted."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from actors.dialect import mavlink
from actors.leading import AGE, PARAMETERS, Lead, Leading
from actors.mavlink import Client, MavlinkError
from actors.telemetry import MOTION

VALUES = dict(zip(PARAMETERS, (2.0, 1.0, 500.0, 300.0), strict=True))


def asked_for(error: float, gain: float, acceleration: float) -> float:
    """m/s, of a position error [m], as ArduPilot's `sqrt_controller` has it."""
    linear = acceleration / gain**2
    if abs(error) <= linear:
        return gain * error
    return math.copysign(math.sqrt(2.0 * acceleration * (abs(error) - 0.5 * linear)), error)


@given(st.floats(0.0, 20.0), st.floats(0.5, 3.0), st.floats(0.5, 9.0))
def test_a_place_so_far_ahead_asks_for_that_speed(speed: float, gain: float, acceleration: float) -> None:
    assert asked_for(Lead(gain, acceleration).distance(speed), gain, acceleration) == pytest.approx(speed, abs=1e-9)


@given(st.tuples(*[st.floats(-5.0, 5.0)] * 3))
def test_the_place_lies_where_the_velocity_points(wanted: tuple[float, float, float]) -> None:
    leading, at, flies = Leading.of(VALUES), np.array([3.0, -2.0, 7.0]), np.array([1.0, 2.0, -0.5])
    ahead = leading.target(at, flies, np.array(wanted)) - at - AGE * flies
    level = math.hypot(*wanted[:2])
    asked = asked_for(math.hypot(*ahead[:2]), 2.0, 5.0)
    assert asked == pytest.approx(level, abs=1e-6)
    assert ahead[:2] * level == pytest.approx(np.array(wanted[:2]) * math.hypot(*ahead[:2]), abs=1e-6)
    assert asked_for(ahead[2], 1.0, 3.0) == pytest.approx(wanted[2], abs=1e-6)


@pytest.mark.parametrize("name", PARAMETERS)
@pytest.mark.parametrize("value", [0.0, -1.0, math.nan, math.inf])
def test_a_parameter_that_makes_no_sense_is_named(name: str, value: float) -> None:
    with pytest.raises(ValueError, match=f"{name} is {value:g}"):
        Leading.of(VALUES | {name: value})


class Vehicle:
    """Hears a client's setpoints."""

    def __init__(self) -> None:
        self._parser = mavlink.MAVLink(None)
        self.heard: list[mavlink.MAVLink_set_position_target_local_ned_message] = []

    def __call__(self, data: bytes) -> None:
        for message in self._parser.parse_buffer(data) or ():
            if message.get_type() == "SET_POSITION_TARGET_LOCAL_NED":
                self.heard.append(message)


def test_who_does_not_know_where_it_is_is_told_velocities_and_then_places() -> None:
    vehicle = Vehicle()
    client = Client(vehicle)
    client.leading = Leading.of(VALUES)
    client.setpoint(np.array([1.0, 0.0, 0.0]))
    client.heard[MOTION] += 1
    client.position, client.velocity = np.array([10.0, 20.0, 30.0]), np.zeros(3)
    client.setpoint(np.array([1.0, 0.0, 2.0]))
    fast, place = vehicle.heard
    ignored = {"x": 1, "y": 2, "z": 4, "vx": 8, "vy": 16, "vz": 32, "yaw": 1024, "yaw_rate": 2048}
    assert (fast.vx, fast.vy, fast.vz) == (0.0, 1.0, 0.0) and all(fast.type_mask & ignored[axis] for axis in "xyz")
    assert (place.x, place.y, place.z) == (20.0, 10.5, -32.0) and not any(place.type_mask & ignored[a] for a in "xyz")
    assert (place.vx, place.vy, place.vz) == (0.0, 0.0, 0.0) and not place.type_mask & ignored["vx"]
    assert place.type_mask & ignored["yaw"] and place.type_mask & ignored["yaw_rate"]


def test_only_an_ardupilot_that_tells_its_controller_is_led() -> None:
    client = Client(lambda data: None)
    wait = lambda condition, seconds: condition()  # noqa: E731
    client.kind = "px4"
    with pytest.raises(MavlinkError, match="only an ArduPilot can be led"):
        client.lead(wait)
    client.kind = "ardupilot"
    with pytest.raises(MavlinkError, match="it has no PSC_POSXY_P, PSC_POSZ_P, WPNAV_ACCEL, WPNAV_ACCEL_Z"):
        client.lead(wait)
    assert client.leading is None

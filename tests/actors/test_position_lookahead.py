"""Places in place of velocities: what a position controller makes of them is the velocity that was wanted."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from brakeline.actors.mavlink.ardupilot_dialect import mavlink
from brakeline.actors.mavlink.autopilot_commands import AutopilotClient, MavlinkError
from brakeline.actors.mavlink.position_lookahead import LATENCY, PARAMETERS, AxisLookahead, PositionLookahead
from brakeline.actors.mavlink.telemetry import MOTION

VALUES = {
    "ardupilot": dict(zip(PARAMETERS["ardupilot"], (2.0, 1.0, 500.0, 300.0), strict=True)),
    "px4": {"MPC_XY_P": 2.0, "MPC_Z_P": 1.0},
}


def asked_for(error: float, gain: float, acceleration: float) -> float:
    """m/s, of a position error [m], as ArduPilot's `sqrt_controller` has it."""
    linear = acceleration / gain**2
    if abs(error) <= linear:
        return gain * error
    return math.copysign(math.sqrt(2.0 * acceleration * (abs(error) - 0.5 * linear)), error)


@given(st.floats(0.0, 20.0), st.floats(0.5, 3.0), st.floats(0.5, 9.0))
def test_a_place_so_far_ahead_asks_for_that_speed(speed: float, gain: float, acceleration: float) -> None:
    assert asked_for(AxisLookahead(gain, acceleration).distance(speed), gain, acceleration) == pytest.approx(
        speed, abs=1e-9
    )


@pytest.mark.parametrize(("kind", "brakes"), [("ardupilot", (5.0, 3.0)), ("px4", (math.inf, math.inf))])
@given(wanted=st.tuples(*[st.floats(-5.0, 5.0)] * 3))
def test_the_place_lies_where_the_velocity_points(
    kind: str, brakes: tuple[float, float], wanted: tuple[float, float, float]
) -> None:
    lookahead, at, flies = (
        PositionLookahead.of(kind, VALUES[kind]),
        np.array([3.0, -2.0, 7.0]),
        np.array([1.0, 2.0, -0.5]),
    )
    ahead = lookahead.target(at, flies, np.array(wanted)) - at - LATENCY * flies
    level = math.hypot(*wanted[:2])
    asked = asked_for(math.hypot(*ahead[:2]), 2.0, brakes[0])
    assert asked == pytest.approx(level, abs=1e-6)
    assert ahead[:2] * level == pytest.approx(np.array(wanted[:2]) * math.hypot(*ahead[:2]), abs=1e-6)
    assert asked_for(ahead[2], 1.0, brakes[1]) == pytest.approx(wanted[2], abs=1e-6)


@pytest.mark.parametrize(("kind", "name"), [(kind, name) for kind, names in PARAMETERS.items() for name in names])
@pytest.mark.parametrize("value", [0.0, -1.0, math.nan, math.inf])
def test_a_parameter_that_makes_no_sense_is_named(kind: str, name: str, value: float) -> None:
    with pytest.raises(ValueError, match=f"{name} is {value:g}"):
        PositionLookahead.of(kind, VALUES[kind] | {name: value})


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
    client = AutopilotClient(vehicle)
    client.lookahead = PositionLookahead.of("ardupilot", VALUES["ardupilot"])
    client.setpoint(np.array([1.0, 0.0, 0.0]))
    client.message_counts[MOTION] += 1
    client.position, client.velocity = np.array([10.0, 20.0, 30.0]), np.zeros(3)
    client.setpoint(np.array([1.0, 0.0, 2.0]))
    fast, place = vehicle.heard
    ignored = {"x": 1, "y": 2, "z": 4, "vx": 8, "vy": 16, "vz": 32, "yaw": 1024, "yaw_rate": 2048}
    assert (fast.vx, fast.vy, fast.vz) == (0.0, 1.0, 0.0) and all(fast.type_mask & ignored[axis] for axis in "xyz")
    assert (place.x, place.y, place.z) == (20.0, 10.5, -32.0) and not any(place.type_mask & ignored[a] for a in "xyz")
    assert (place.vx, place.vy, place.vz) == (0.0, 0.0, 0.0) and not place.type_mask & ignored["vx"]
    assert place.type_mask & ignored["yaw"] and place.type_mask & ignored["yaw_rate"]


@pytest.mark.parametrize("kind", PARAMETERS)
def test_only_who_tells_its_controller_is_led(kind: str) -> None:
    client = AutopilotClient(lambda data: None)
    wait = lambda condition, seconds: condition()  # noqa: E731
    client.kind = kind
    with pytest.raises(MavlinkError, match=f"the autopilot has no {', '.join(PARAMETERS[kind])}: fly it by velocities"):
        client.lead(wait)
    assert client.lookahead is None

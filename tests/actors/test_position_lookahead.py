"""Positions instead of velocities: the position controller turns them into the wanted velocity."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from brakeline.actors.mavlink.ardupilot_dialect import mavlink
from brakeline.actors.mavlink.autopilot_commands import AutopilotClient
from brakeline.actors.mavlink.position_lookahead import LATENCY, PARAMETERS, AxisLookahead, PositionLookahead
from brakeline.actors.mavlink.telemetry import MOTION
from brakeline.errors import MavlinkError

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


class SetpointRecorder:
    """Records a client's setpoints."""

    def __init__(self) -> None:
        self._parser = mavlink.MAVLink(None)
        self.setpoints: list[mavlink.MAVLink_set_position_target_local_ned_message] = []

    def __call__(self, data: bytes) -> None:
        for message in self._parser.parse_buffer(data) or ():
            if message.get_type() == "SET_POSITION_TARGET_LOCAL_NED":
                self.setpoints.append(message)


def test_velocities_are_sent_until_the_position_is_known_and_then_positions() -> None:
    recorder = SetpointRecorder()
    client = AutopilotClient(recorder)
    client.lookahead = PositionLookahead.of("ardupilot", VALUES["ardupilot"])
    client.setpoint(np.array([1.0, 0.0, 0.0]))
    client.message_counts[MOTION] += 1
    client.position, client.velocity = np.array([10.0, 20.0, 30.0]), np.zeros(3)
    client.setpoint(np.array([1.0, 0.0, 2.0]))
    fast, place = recorder.setpoints
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

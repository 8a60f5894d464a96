"""The MAVLink client and the quadrotor in lockstep, with the rules of both autopilots."""

from __future__ import annotations

import json

import numpy as np
import pytest

from brakeline.actors.mavlink.ardupilot_dialect import mavlink
from brakeline.actors.mavlink.autopilot_commands import AutopilotClient
from brakeline.actors.mavlink.frame_log import CapturedFrame
from brakeline.actors.mavlink.lockstep_quadrotor import LockstepQuadrotor
from brakeline.errors import BadInput, CommandRefused, NoAutopilot
from brakeline.messaging.obstacle import CYLINDER, Obstacle
from brakeline.sim.autopilot.autopilot_rules import SETPOINT_TIMEOUT as TIMEOUT
from brakeline.sim.autopilot.endpoint import Autopilot
from brakeline.sim.autopilot.flight_modes import Mode
from brakeline.sim.autopilot.parameters import AT_ONCE
from brakeline.sim.flight_estimator import QuadrotorNoise
from brakeline.sim.quadrotor import SAMPLES, Quadrotor
from tests.robots import QUADROTOR
from tests.sim.station import field

RULES = ("px4", "ardupilot")


def quadrotor(*obstacles: Obstacle, floor: float | None = None, scale: float = 1.0) -> Quadrotor:
    return Quadrotor(field(*obstacles), np.random.default_rng(0), QuadrotorNoise(scale=scale), floor=floor)


def embedded(rules: str, *obstacles: Obstacle) -> Autopilot:
    return Autopilot(quadrotor(*obstacles), rules, parameters={TIMEOUT[rules]: 0.2}, quiet=True)


@pytest.mark.parametrize("rules", RULES)
def test_the_vehicle_is_under_control_before_time_begins(rules: str) -> None:
    autopilot = embedded(rules)
    vehicle = LockstepQuadrotor(autopilot, QUADROTOR)
    assert autopilot.flight.time == 0.0
    assert autopilot.flight.mode is Mode.OFFBOARD
    assert vehicle.initial_period().clearance > 9.0


@pytest.mark.parametrize("rules, name, value", [("px4", "COM_OBL_RC_ACT", 4), ("ardupilot", "LAND_SPEED", 50)])
def test_an_integer_parameter_is_set_in_each_autopilots_encoding(rules: str, name: str, value: int) -> None:
    autopilot = embedded(rules)
    vehicle = LockstepQuadrotor(autopilot, QUADROTOR)
    assert vehicle._client.set_parameter(name, value, vehicle._wait)
    assert autopilot.parameters[name] == value
    assert not vehicle._client.set_parameter(name, 1e6, vehicle._wait), "out of its range"
    assert not vehicle._client.set_parameter("NONSENSE", 1.0, vehicle._wait)


@pytest.mark.parametrize("rules", RULES)
def test_a_flight_over_mavlink_equals_one_without_it(rules: str) -> None:
    """Same seed and inputs give the same flight, except for rounding to float32 and to ArduPilot's milligravities."""
    rounding = np.array(6 * [2e-3] + 3 * [{"px4": 2e-3, "ardupilot": 0.02}[rules]])
    bare, flown = quadrotor(scale=0.0), Autopilot(quadrotor(scale=0.0), rules, parameters=AT_ONCE[rules], quiet=True)
    vehicle = LockstepQuadrotor(flown, QUADROTOR)
    rng = np.random.default_rng(1)
    for _ in range(40):
        input = rng.uniform(-5.0, 5.0, 3)
        period, direct = vehicle.step(input), bare.step(input)
        assert vehicle.input == pytest.approx(bare.input)
        assert period.true == pytest.approx(direct.true, abs=1e-3)
        assert (np.abs(period.measured - direct.measured) < rounding).all()
        assert period.subsamples == pytest.approx(direct.subsamples, abs=1e-3)
        assert period.clearance == pytest.approx(direct.clearance, abs=1e-3)
        assert period.closest <= direct.closest + 1e-3  # sampled more often
    with pytest.raises(BadInput):
        vehicle.step(np.array([np.nan, 0.0, 0.0]))


def test_the_error_of_telemetry_stays_within_the_measurement_bound() -> None:
    vehicle, rng = LockstepQuadrotor(embedded("px4"), QUADROTOR), np.random.default_rng(2)
    worst = np.zeros(9)
    for _ in range(150):
        before = vehicle.measured[:3]
        period = vehicle.step(vehicle.input + rng.choice([-0.8, 0.8], 3))
        worst = np.maximum(worst, np.abs(period.measured - period.true))
        assert period.subsamples.shape == (SAMPLES, 3)
        assert period.subsamples[-1] == pytest.approx(period.measured[:3] - before)
    assert (worst < QUADROTOR.measurement_bound).all()


def test_periods_are_shorter_than_the_setpoint_timeout() -> None:
    autopilot = embedded("px4")
    vehicle = LockstepQuadrotor(autopilot, QUADROTOR)
    for _ in range(50):
        vehicle.step(np.array([2.0, 0.0, 0.0]))
    assert autopilot.flight.mode is Mode.OFFBOARD
    autopilot.advance(0.22)  # without another step
    assert autopilot.flight.mode is Mode.POSITION


def test_collisions_come_from_the_simulator() -> None:
    vehicle = LockstepQuadrotor(embedded("px4", Obstacle(CYLINDER, (3.0, 0.0, 10.0), (0.5, 10.0))), QUADROTOR)
    assert any(vehicle.step(np.array([3.0, 0.0, 0.0])).collision for _ in range(12))


def test_the_tap_gets_every_frame_and_each_can_be_decoded() -> None:
    frames: list[CapturedFrame] = []
    vehicle = LockstepQuadrotor(embedded("px4"), QUADROTOR, frames.append)
    frames.clear()
    vehicle.step(np.array([0.5, 0.0, 0.0]))
    names = [(frame.outgoing, frame.name) for frame in frames]
    assert names.count((True, "mavlink/245/191/SET_POSITION_TARGET_LOCAL_NED")) == 1
    assert names.count((False, "mavlink/1/1/LOCAL_POSITION_NED")) == SAMPLES
    decoded = mavlink.MAVLink(None).parse_buffer(b"".join(frame.raw for frame in frames))
    assert [message.get_type() for message in decoded] == [frame.message.get_type() for frame in frames]
    sent = next(frame for frame in frames if frame.outgoing)
    assert json.loads(json.dumps(sent.fields))["vy"] == pytest.approx(0.5)  # east


def test_a_missing_autopilot_and_refusals_are_errors() -> None:
    client = AutopilotClient(lambda _: None)
    with pytest.raises(NoAutopilot):
        client.identify(lambda condition, _: condition())
    with pytest.raises(CommandRefused, match="no answer"):
        client.arm(lambda condition, _: condition())
    autopilot = Autopilot(quadrotor(floor=0.02), "ardupilot")
    client = AutopilotClient(autopilot.receive)

    def wait(condition, seconds):  # type: ignore[no-untyped-def]
        autopilot.advance(0.1)
        client.feed(autopilot.take())
        return condition()

    with pytest.raises(CommandRefused, match=r"NAV_TAKEOFF: failed.*not in guided"):
        client.take_off(3.0, wait)

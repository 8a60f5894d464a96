"""Messages between an actor and a vehicle server survive a conversion, and invalid ones are refused."""

from __future__ import annotations

import contextlib
import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from brakeline.actors.actor_settings import FlightSettings
from brakeline.actors.mavlink.periodic_vehicle import ControlPeriod
from brakeline.actors.mavlink.vehicle_messages import (
    FlightRequest,
    error_message,
    error_of,
    period_message,
    period_of,
    plan_of,
    request_message,
    request_of,
    text_of,
)
from brakeline.actors.mavlink.vehicle_socket import LARGEST
from brakeline.errors import BadInput, BadLink, BadMessage, CommandLost, CommandRefused, HandoverRefused, MavlinkError
from brakeline.messaging import brakeline_pb2 as pb
from brakeline.messaging.obstacle import Obstacle
from brakeline.messaging.obstacle_motion import Motion
from brakeline.messaging.robot import robot_named
from brakeline.sim.quadrotor import SAMPLES
from brakeline.sim.vehicle import Period
from tests.actors.test_flight_process import STANDING
from tests.robots import GROUND, QUADROTOR

LATE = QUADROTOR.in_real_time()
MAP = (
    Obstacle("box", (1.0, -2.0, 0.5), (1.0, 2.0, 3.0), 0.3, -0.1),
    Obstacle("sphere", (0.0, 4.0, 2.0), (0.5,), motion=Motion((0.1, 0.0, 0.0), 0.01, 0.02, acceleration=0.5)),
)
REQUEST = FlightRequest(
    FlightSettings("udpin:0.0.0.0:14540", 7, 9000, 2.5, (1.0, -2.0, 0.1), True, True, 0.2), LATE, MAP
)


@pytest.mark.parametrize("robot", [robot_named("quadrotor"), robot_named("quadrotor-late")])
def test_a_flight_request_survives_a_conversion(robot):
    request = FlightRequest(REQUEST.flight, robot, MAP)
    data = request_message(request).SerializeToString()
    assert request_of(pb.FlightRequest.FromString(data)) == request


@given(lost=st.text())
def test_a_control_period_survives_a_conversion(lost):
    values = np.random.default_rng(0).uniform(-1e6, 1e6, 21 + 3 * SAMPLES)
    path = values[21:].reshape(SAMPLES, 3)
    report = Period(values[:9], values[9:18], True, math.inf, -0.25, path, 0.5)
    period = period_of(period_message(ControlPeriod(2**40, values[18:21], report, lost)), LATE)
    assert (period.number, period.lost) == (2**40, text_of(lost))
    assert (period.report.collision, period.report.closest, period.report.clearance) == (True, math.inf, -0.25)
    assert period.report.turned == 0.5 and np.array_equal(period.report.subsamples, path)
    assert np.array_equal(period.report.measured, values[:9]) and np.array_equal(period.report.true, values[9:18])
    assert np.array_equal(period.input, values[18:21])


@pytest.mark.parametrize(
    "spoil",
    [
        lambda m: m.measured.append(0.0),
        lambda m: m.measured.pop(),
        lambda m: m.true_state.__setitem__(0, math.nan),
        lambda m: m.input.__setitem__(2, math.inf),
        lambda m: m.path.pop(),
        lambda m: setattr(m, "clearance", math.nan),
        lambda m: setattr(m, "closest", math.nan),
        lambda m: setattr(m, "turned", math.inf),
    ],
)
def test_an_invalid_control_period_is_refused(spoil):
    message = period_message(ControlPeriod(1, np.zeros(3), STANDING))
    period_of(message, LATE)
    spoil(message)
    with pytest.raises(BadMessage):
        period_of(message, LATE)


@pytest.mark.parametrize(
    "change",
    [
        {"robot": "nonsense"},
        {"robot": "null"},
        {"robot": "[" * 100_000},
        {"origin": [0.0, 1.0]},
        {"origin": [0.0, 1.0, math.nan]},
        {"origin": [0.0, 1.0, 1e6]},
        {"height": math.nan},
        {"height": -1.0},
        {"system": 256},
        {"system": 0},
        {"truth": 70_000},
        {"obstacles": [pb.Obstacle(kind="tree", position=[0.0, 0.0, 0.0])]},
        {"obstacles": [pb.Obstacle(kind="sphere", position=[0.0, 0.0], size=[1.0])]},
        {"obstacles": [pb.Obstacle(kind="sphere", position=[0.0, 0.0, math.nan], size=[1.0])]},
    ],
)
def test_an_invalid_flight_request_is_refused(change):
    message = request_message(REQUEST)
    for name in change:
        message.ClearField(name)
    message.MergeFrom(pb.FlightRequest(**change))
    with pytest.raises(BadMessage):
        request_of(message)


def test_a_request_for_another_kind_of_robot_is_refused():
    with pytest.raises(BadMessage, match="than a quadrotor"):
        request_of(request_message(FlightRequest(REQUEST.flight, GROUND, ())))


@given(st.binary(max_size=300))
def test_arbitrary_bytes_are_read_or_refused(data):
    for kind, read in (
        (pb.FlightRequest, request_of),
        (pb.ControlPeriod, lambda m: period_of(m, LATE)),
        (pb.PlanCommit, lambda m: plan_of(m, LATE, 0)),
    ):
        try:
            message = kind.FromString(data)
        except Exception:
            continue
        with contextlib.suppress(BadMessage):
            read(message)


@pytest.mark.parametrize(
    ("error", "kind"),
    [
        (HandoverRefused("a"), HandoverRefused),
        (CommandRefused("a"), MavlinkError),
        (CommandLost("a"), CommandLost),
        (BadInput("a"), BadInput),
        (BadLink("a"), BadLink),
        (BadMessage("a"), BadMessage),
        (PermissionError(13, "a"), OSError),
        (KeyError("a"), MavlinkError),
    ],
)
def test_a_known_error_keeps_its_type(error, kind):
    received = error_of(error_message(error))
    assert type(received) is kind and "a" in str(received)


def test_a_long_error_is_cut_and_an_unknown_type_becomes_a_mavlink_error():
    assert len(error_message(ValueError("x" * 10 * LARGEST)).SerializeToString()) < LARGEST
    assert error_message(ValueError("\ud800")).message == "?"
    assert type(error_of(pb.Error(type="SystemExit", message="0"))) is MavlinkError

"""Steps of a flight in which the vehicle did not follow, or its state was not known, say so."""

from __future__ import annotations

from collections import Counter
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from brakeline.actors.decision_guard import DecisionOutcome
from brakeline.actors.flight_process import FlightRunner
from brakeline.actors.mavlink.periodic_vehicle import ControlPeriod
from brakeline.messaging import brakeline_pb2 as pb
from brakeline.sim.quadrotor import SAMPLES
from brakeline.sim.vehicle import Period

HELD = "the autopilot does not follow our setpoints (HOLD)"
STANDING = Period(np.zeros(9), np.zeros(9), False, np.inf, np.inf, np.zeros((SAMPLES, 3)), 0.0)


@pytest.mark.parametrize(("before", "after"), [("", ""), (HELD, ""), ("", HELD), (HELD, HELD)])
def test_a_step_between_two_states_is_lost_if_one_of_them_is(before: str, after: str) -> None:
    published: list[pb.Step] = []
    runner: Any = FlightRunner.__new__(FlightRunner)
    runner.steps, runner.frames = SimpleNamespace(put=published.append), SimpleNamespace(publish=lambda: None)
    runner.answers, period = Counter(), ControlPeriod(4, np.zeros(3), STANDING, before)
    runner._vehicle = SimpleNamespace(current_period=period)
    runner.commit(DecisionOutcome(pb.Request(), None, None, "no answer", 0.0))
    runner._vehicle.current_period = replace(period, number=5, lost=after)
    runner.publish(pb.Step(index=1))
    assert [step.lost for step in published] == [bool(before or after)]

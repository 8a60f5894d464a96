"""Steps of a flight in which the vehicle did not follow, or its state was not known, say so."""

from __future__ import annotations

from collections import Counter
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from brakeline.actors.actor_process import ActorSettings
from brakeline.actors.decision_guard import DecisionOutcome
from brakeline.actors.flight_process import BackgroundPublisher, FlightRunner, RealTimeVehicle
from brakeline.actors.mavlink.periodic_vehicle import ControlPeriod, PeriodicVehicle
from brakeline.messaging import brakeline_pb2 as pb
from brakeline.messaging.bus import BusSettings
from brakeline.messaging.free_ports import free_endpoint
from brakeline.messaging.process_runtime import Process
from brakeline.safety.filter.backup_plan import UNVERIFIED, BackupPlan
from brakeline.sim.quadrotor import SAMPLES
from brakeline.sim.sim_conditions import Conditions
from brakeline.sim.vehicle import Period
from tests.arenas import staged_arena
from tests.robots import QUADROTOR

HELD = "the autopilot does not follow our setpoints (HOLD)"
STANDING = Period(np.zeros(9), np.zeros(9), False, np.inf, np.inf, np.zeros((SAMPLES, 3)), 0.0)


@pytest.mark.parametrize(("before", "after"), [("", ""), (HELD, ""), ("", HELD), (HELD, HELD)])
def test_a_step_between_two_states_is_lost_if_one_of_them_is(before: str, after: str) -> None:
    published: list[pb.Step] = []
    runner: Any = FlightRunner.__new__(FlightRunner)
    runner.steps, runner.frames = SimpleNamespace(put=published.append), SimpleNamespace(publish=lambda: None)
    runner.runner = SimpleNamespace(backup_plan=BackupPlan(QUADROTOR.in_real_time()))
    runner.answers, period = Counter(), ControlPeriod(4, np.zeros(3), STANDING, before)
    runner._vehicle = SimpleNamespace(current_period=period)
    runner.commit(DecisionOutcome(pb.Request(), None, None, "no answer", 0.0))
    runner._vehicle.current_period = replace(period, number=5, lost=after)
    runner.publish(pb.Step(index=1))
    assert [step.lost for step in published] == [bool(before or after)]
    assert (runner.runner.backup_plan.model == UNVERIFIED) == bool(before)


def test_its_requests_state_the_age_of_the_acceleration_in_its_states() -> None:
    """They stated 0 s, so the service refused every request of a flight whose model set needs 0.2 s."""
    flown: Any = SimpleNamespace(
        current_period=ControlPeriod(4, np.zeros(3), STANDING),
        wait=lambda number: ControlPeriod(number, np.zeros(3), STANDING),
    )
    settings = ActorSettings(BusSettings(listen=(free_endpoint(),)), "quadrotor-late")
    stage, publisher = staged_arena(start=(0.0, 0.0, 3.0), goal=(4.0, 0.0, 3.0), height=6.0), BackgroundPublisher()
    with Process(settings.bus, settings.name) as process:
        runner = FlightRunner(process, settings, [stage], lambda _: hover, publisher, Conditions(), 0.2)
        runner.take(flown)
        runner.runner.begin(0)
        publisher.close()
    assert runner.runner.request(np.zeros(3)).acceleration_age == 0.2


def hover(observation: Any, info: Any) -> np.ndarray:
    return np.zeros(3)


@pytest.mark.parametrize("number", [5, 7])
def test_a_plan_whose_input_the_vehicle_does_not_execute_is_not_verified(number: int) -> None:
    """Such as after a standstill of the vehicle server, whose slew limits the input that follows."""
    plan = BackupPlan(QUADROTOR.in_real_time())
    rows = np.outer(0.5 * np.maximum(6.0 - np.arange(plan.robot.horizon), 0.0), [1.0, 0.0, 0.0])
    plan.accept(rows, "m", None, verified=True)
    flown: Any = SimpleNamespace(current_period=ControlPeriod(4, rows[0], STANDING))
    vehicle = RealTimeVehicle(flown, plan.fallback, plan.executes, acceleration_age=0.0)
    flown.wait = lambda _: ControlPeriod(number, rows[number - 4], STANDING)
    vehicle.step(rows[1])
    assert plan.model == "m" and plan.next_input == pytest.approx(rows[number - 4])
    plan.fallback()
    flown.wait = lambda _: ControlPeriod(number + 1, rows[number - 4], STANDING)
    vehicle.step(rows[number - 3])
    assert plan.model == UNVERIFIED and plan.next_input == pytest.approx(rows[number - 4])


@pytest.mark.parametrize(("lost", "counts"), [(4, False), (5, True), (6, True), (7, True)])
def test_a_step_is_lost_if_a_period_that_it_skipped_was(lost: int, counts: bool) -> None:
    """The environment observed period 4, and then period 7. The state of period 4 counted for the step before."""
    flown, plan = PeriodicVehicle(QUADROTOR.in_real_time()), BackupPlan(QUADROTOR.in_real_time())
    flown._begin(ControlPeriod(4, np.zeros(3), STANDING, HELD if lost == 4 else ""))
    vehicle: Any = RealTimeVehicle(flown, plan.fallback, plan.executes, acceleration_age=0.0)  # type: ignore[arg-type]
    for number in (5, 6, 7):
        flown._begin(ControlPeriod(number, np.zeros(3), STANDING, HELD if lost == number else ""))
    vehicle.step(np.zeros(3))
    assert vehicle.current_period.number == 7 and vehicle.skipped == 2
    assert vehicle.current_period.lost == (HELD if counts else "")

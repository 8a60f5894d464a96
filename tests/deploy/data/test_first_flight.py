"""The first flight of an unknown vehicle, with one that needs no time: it stays in its box; faster by levels."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from brakeline.actors.mavlink.periodic_vehicle import ControlPeriod
from brakeline.deploy.data.first_flight import (
    LEVELS,
    Box,
    FirstFlight,
    FirstFlightResult,
    draw_leg,
)
from brakeline.errors import CommandLost
from brakeline.safety.model.dataset import Dataset
from brakeline.safety.model.model_set import ONE_STEP
from brakeline.safety.model.windows import PLAN, windows
from brakeline.sim.quadrotor import SAMPLES
from brakeline.sim.vehicle import Period
from tests.robots import QUADROTOR

LATE = QUADROTOR.in_real_time()
BOX = Box(np.array([1.0, -2.0, 30.0]), np.array([40.0, 40.0, 20.0]))


class Sluggish:
    """A vehicle that comes to its setpoint by a time constant; a turn passes whenever somebody waits for it."""

    def __init__(
        self, constant: float = 0.4, drift: float = 0.0, fickle: bool = False, disarms: float = np.inf
    ) -> None:
        self.disarms = disarms  # after this period
        self.fickle = fickle  # follows its setpoint or the opposite of it
        self.constant, self.drift, self.rng = constant, drift, np.random.default_rng(0)
        self.position, self.velocity, self.acceleration = BOX.middle.copy(), np.zeros(3), np.zeros(3)
        self.plan: list[np.ndarray] = []
        self.farthest, self.fastest = -np.inf, 0.0
        self.current_period = ControlPeriod(0, np.zeros(3), self._report(np.zeros((SAMPLES, 3))))

    def commit(self, plan: np.ndarray, number: int) -> bool:
        self.plan = [QUADROTOR.clip_input(row, row) for row in plan]
        return True

    def wait(self, number: int) -> ControlPeriod:
        while self.current_period.number < number:
            self._pass()
        if number > self.disarms:
            raise CommandLost("our command of the vehicle has ended: it has disarmed")
        return self.current_period

    def _pass(self) -> None:
        path, start = [], self.position.copy()
        setpoint = self.current_period.input * (self.rng.choice([-1.0, 1.0]) if self.fickle else 1.0)
        for _ in range(SAMPLES):
            self.acceleration = (setpoint - self.velocity) / self.constant
            self.velocity = self.velocity + self.acceleration * 0.2 / SAMPLES
            self.position = self.position + (self.velocity + self.drift) * 0.2 / SAMPLES
            path.append(self.position - start)
        self.farthest = max(self.farthest, BOX.outside(self.position))
        self.fastest = max(self.fastest, float(np.abs(self.velocity).max()))
        following = self.plan.pop(0) if self.plan else np.zeros(3)
        self.current_period = ControlPeriod(
            self.current_period.number + 1,
            QUADROTOR.clip_input(following, self.current_period.input),
            self._report(np.array(path)),
        )

    def _report(self, path: np.ndarray) -> Period:
        state = np.concatenate([self.position, self.velocity, self.acceleration])
        measured = state + self.rng.uniform(-0.01, 0.01, 9)
        return Period(measured, state, False, np.inf, np.inf, path, 0.0)


def flown(vehicle: Sluggish, minutes: float, about: dict[str, str] | None = None, seed: int = 0) -> FirstFlightResult:
    flight = FirstFlight(vehicle, LATE, BOX, seed, about or {})
    flight.fly(minutes)
    return flight.result(lambda data: None)


def test_an_obedient_vehicle_is_flown_at_every_level_and_stays_inside(tmp_path: Path) -> None:
    vehicle = Sluggish()
    recording = flown(vehicle, 4.0, {"autopilot": "none"})
    assert recording.level == LEVELS[-1] and vehicle.fastest > 4.0 and vehicle.farthest < 0.0
    assert recording.model is not None and recording.model.robot == LATE
    assert recording.report is not None and recording.report.violations <= 0.25 * recording.report.windows
    assert recording.model.model_config.mode == ONE_STEP and 4.0 * 60.0 <= recording.seconds < 5.3 * 60.0
    assert any("more minutes like these" in line for line in recording.missing)
    assert not any("of its own estimate is" in line for line in recording.missing)
    recording.data.save(tmp_path / "flown.safetensors")
    assert Dataset.load(tmp_path / "flown.safetensors").digest() == recording.data.digest()
    assert len(windows(recording.data, QUADROTOR.horizon, PLAN)) > 20, "it brakes as the filter plans to"


def test_the_recorded_inputs_are_those_of_the_recorded_periods() -> None:
    """The velocity follows the input of its own period, not of the next."""
    recording = flown(Sluggish(constant=0.05), 2.0, seed=1)
    for t in recording.data.trajectories:
        assert t.states[1:, 3:6] == pytest.approx(t.inputs, abs=0.1)


@pytest.mark.parametrize(
    ("fault", "minutes", "line"),
    [
        ({"fickle": True}, 2.0, "no model predicts the vehicle at 20% of its speed, so it was not flown faster"),
        ({"drift": 0.3}, 2.0, "the position of its own estimate is 0."),
        ({"drift": 2.0}, 4.0, "it left its box"),
        ({"disarms": 400}, 4.0, "it has disarmed"),
    ],
)
def test_what_ends_a_flight_or_makes_its_sets_wide_is_named(fault, minutes, line) -> None:
    vehicle = Sluggish(**fault)
    recording = flown(vehicle, minutes)
    assert any(line in text for text in recording.missing)
    assert recording.seconds < 120.0 or ("box" not in line and "disarmed" not in line)
    assert len(recording.data.trajectories) > 0, "what was recorded stays"
    assert (recording.level == 0.0 and vehicle.fastest < 1.5) or "fickle" not in fault


def test_an_error_of_the_program_ends_a_flight_and_what_was_recorded_is_stored(monkeypatch) -> None:
    def diverge(*_, **__):
        raise np.linalg.LinAlgError("SVD did not converge")

    stored = list[Dataset]()
    flight = FirstFlight(Sluggish(), LATE, BOX, 0, {})
    with monkeypatch.context() as patch:
        patch.setattr(np.linalg, "lstsq", diverge)
        flight.fly(2.0)
    missing = flight.result(stored.append).missing
    assert stored[0].periods > 50 and "the flight ended with an error: LinAlgError: SVD did not converge" in missing


def test_the_rule_turns_back_before_the_wall_and_lets_go_of_the_rest() -> None:
    level = QUADROTOR.high()
    near = np.array([31.0, -2.0, 30.0, 5.0, *[0.0] * 5])
    assert BOX.constrain(near, np.array([5.0, 3.0, 0.0]), level) == pytest.approx([-2.5, 3.0, 0.0])
    leaving = near * [1, 1, 1, -1, 1, 1, 1, 1, 1]
    assert BOX.constrain(leaving, np.array([-5.0, 0.0, 0.0]), level)[0] == -5.0, "it leads back"
    middle = np.concatenate([BOX.middle, np.full(3, 5.0), np.zeros(3)])
    assert BOX.constrain(middle, level, level) == pytest.approx(level)


def test_a_leg_keeps_the_slew_and_leads_back_from_a_wall() -> None:
    rng, slew = np.random.default_rng(2), np.asarray(QUADROTOR.action_slew)
    near = np.array([26.0, -27.0, 30.0, *[0.0] * 6])
    before, stops = np.zeros(3), 0
    for _ in range(500):
        inputs = np.array(draw_leg(LATE, BOX, 0.5, near, before, rng))
        assert (np.abs(np.diff(inputs, axis=0, prepend=before[None])) <= slew + 1e-9).all()
        assert np.abs(inputs).max() <= 2.5 and inputs[:, 0].max() <= 1e-9 and inputs[:, 1].min() >= -1e-9
        stops += bool(before.any()) and not inputs[-1].any()
        before = inputs[-1]
    assert stops > 50, "some legs stop"


def test_minutes_of_first_flight_hold_much_fast_flight() -> None:
    """Errors are largest there, and with few windows a few decide about all sets."""
    data = flown(Sluggish(), 4.0).data
    speeds = np.concatenate([np.abs(t.states[:, 3:5]).max(1) for t in data.trajectories])
    assert (speeds > 2.5).mean() > 0.2

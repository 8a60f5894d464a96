"""A first flight ends on the ground, however it ends; a vehicle that somebody else has is left alone."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from brakeline.actors.actor_settings import FlightSettings
from brakeline.actors.mavlink.mavlink_vehicle import MavlinkVehicle
from brakeline.deploy.data import first_flight
from brakeline.deploy.data.first_flight import FirstFlight
from brakeline.deploy.data.partial_save import PartialSave, partial_path
from brakeline.deploy.data.trajectory_builder import TrajectoryBuilder
from brakeline.deploy.run import first_flight_run
from brakeline.deploy.run.first_flight_run import FirstFlightSettings
from brakeline.errors import BadData, FlightEnded, MavlinkError
from brakeline.messaging.acceleration_age import ENTRY
from brakeline.safety.model.dataset import Dataset
from brakeline.sim.autopilot.endpoint import Autopilot
from brakeline.sim.autopilot.flight_modes import Mode
from tests.actors.conftest import served
from tests.actors.test_lockstep_quadrotor import quadrotor
from tests.robots import QUADROTOR
from tests.waiting import until

LATE = QUADROTOR.in_real_time()
SETTINGS = FirstFlightSettings(height=1.0, room=20.0, minutes=1.0)


@pytest.fixture
def standing() -> Iterator[tuple[str, Autopilot]]:
    autopilot = Autopilot(quadrotor(floor=0.02), "px4")
    with served(autopilot) as url:
        yield url, autopilot


@pytest.mark.parametrize(
    ("error", "said"), [(FlightEnded("the flight was stopped"), "stopped"), (RuntimeError("a defect"), "a defect")]
)
def test_a_flight_that_ends_at_once_or_fails_lands(
    standing: tuple[str, Autopilot],
    monkeypatch: pytest.MonkeyPatch,
    tmp_path: Path,
    error: Exception,
    said: str,
) -> None:
    url, autopilot = standing

    def record(self: FirstFlight, level: float, seconds: float) -> None:
        assert autopilot.flight.armed
        raise error

    monkeypatch.setattr(FirstFlight, "_record", record)
    with pytest.raises(BadData, match=f"nothing was recorded: .*{said}"):
        first_flight_run.fly(LATE, url, 0, SETTINGS, tmp_path / "flown.safetensors")
    assert not autopilot.flight.armed and autopilot.vehicle.on_floor


def test_a_killed_flight_leaves_what_it_recorded_and_an_interrupted_fit_the_whole_flight(
    standing: tuple[str, Autopilot], monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture, tmp_path: Path
) -> None:
    path, kept = tmp_path / "flown.safetensors", list[Dataset]()
    part = partial_path(path)
    monkeypatch.setattr(first_flight, "PIECE", 10)
    part.write_bytes(b"of an earlier flight")

    def land_late(vehicle: MavlinkVehicle, periods: int) -> None:
        until(part.exists, "a part is stored")
        kept.append(Dataset.load(part))
        land(vehicle, periods)

    def fit(self: FirstFlight, data: Dataset, missing: list[str]) -> None:
        raise KeyboardInterrupt

    land = first_flight_run.land
    monkeypatch.setattr(first_flight_run, "land", land_late)
    monkeypatch.setattr(FirstFlight, "_model", fit)
    with pytest.raises(KeyboardInterrupt):
        first_flight_run.fly(LATE, standing[0], 0, replace(SETTINGS, minutes=0.1), path)
    whole = Dataset.load(path)
    assert whole.about.get(ENTRY, "0") == "0", "a PX4's acceleration is of now"
    assert kept[0].periods >= 10 and kept[0].about == whole.about and kept[0].periods <= whole.periods
    assert not part.exists() and (tmp_path / "flown.part.earlier.safetensors").exists()
    assert "cut off" in caplog.text


def test_a_flight_goes_on_if_its_part_cannot_be_saved(caplog: pytest.LogCaptureFixture, tmp_path: Path) -> None:
    partial = PartialSave(tmp_path / "no folder" / "flown.part.safetensors")
    (tmp_path / "no folder").write_text("a file")
    built = TrajectoryBuilder(np.zeros(9))
    built.add(np.zeros(3), np.zeros(9), np.zeros((4, 3)))
    partial.offer(lambda: Dataset(QUADROTOR, (built.trajectory(),)))
    partial.finish()
    assert "in memory only" in caplog.text


@pytest.mark.parametrize(("asked", "age"), [(None, 0.2), (0.0, 0.0)])
def test_a_first_flight_records_the_acceleration_of_some_time_ago_and_says_so(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, asked: float | None, age: float
) -> None:
    path, ages = tmp_path / "flown.safetensors", list[float]()

    def record(self: FirstFlight, level: float, seconds: float) -> None:
        ages.append(self._vehicle.acceleration_age)
        raise FlightEnded("that is enough")

    monkeypatch.setattr(FirstFlight, "_record", record)
    monkeypatch.setattr(FirstFlight, "result", lambda self, store: self._about)
    with served(Autopilot(quadrotor(floor=0.02), "ardupilot")) as url:
        about = first_flight_run.fly(LATE, url, 0, replace(SETTINGS, acceleration_age=asked), path)
    assert about.get(ENTRY, "0") == f"{age:g}" and ages == [age]


def test_a_pilot_who_took_the_vehicle_keeps_it(
    standing: tuple[str, Autopilot], monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture, tmp_path: Path
) -> None:
    url, autopilot = standing

    def record(self: FirstFlight, level: float, seconds: float) -> None:
        autopilot.flight.change(Mode.HOLD)
        self._wait_for_link()
        until(lambda: self._vehicle.current_period.lost != "", "its heartbeat says so")
        raise FlightEnded("no control of the vehicle for 10 s")

    monkeypatch.setattr(FirstFlight, "_record", record)
    with pytest.raises(BadData, match="nothing was recorded: no control"):
        first_flight_run.fly(LATE, url, 0, SETTINGS, tmp_path / "flown.safetensors")
    assert autopilot.flight.armed and autopilot.flight.mode is Mode.HOLD
    assert any("not landing" in record.message for record in caplog.records)


def test_a_takeoff_that_is_stopped_lands(standing: tuple[str, Autopilot]) -> None:
    url, autopilot = standing
    with pytest.raises(MavlinkError, match="asked to stop"):
        MavlinkVehicle(
            QUADROTOR, FlightSettings(url, height=30.0), stop=lambda: float(autopilot.vehicle.state()[2]) > 1.0
        )
    until(lambda: not autopilot.flight.armed, "it lands", 30.0)


def test_a_first_flight_does_not_begin_in_the_air(tmp_path: Path) -> None:
    """Its box reaches two thirds of --height below the place where it begins."""
    autopilot = Autopilot(quadrotor(), "px4")
    with served(autopilot) as url, pytest.raises(MavlinkError, match="flies already"):
        first_flight_run.fly(LATE, url, 0, SETTINGS, tmp_path / "flown.safetensors")
    assert autopilot.flight.mode is not Mode.OFFBOARD

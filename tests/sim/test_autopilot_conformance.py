"""The embedded autopilot answers the requests of the conformance benchmark by its rules, in simulated time."""

from __future__ import annotations

import pytest

from benchmarks import sitl
from benchmarks.autopilot_conformance import on_the_ground
from benchmarks.ground_station import Station
from brakeline.deploy.run.autopilot_run import AutopilotSettings, open_field, vehicle
from brakeline.sim.autopilot.endpoint import Autopilot


class SimulatedLink:
    """A link to an autopilot in this process, and the clock of that autopilot."""

    def __init__(self, autopilot: Autopilot) -> None:
        self.send, self.receive, self.sleep = autopilot.receive, autopilot.take, autopilot.advance
        self.monotonic = lambda: autopilot.flight.time


def test_an_embedded_one_answers_on_the_ground(monkeypatch: pytest.MonkeyPatch) -> None:
    link = SimulatedLink(vehicle(AutopilotSettings("", "ardupilot"), open_field(), 1))
    for module in ("ground_station", "autopilot_conformance"):
        monkeypatch.setattr(f"benchmarks.{module}.time", link)
    answers = on_the_ground(Station(link, 1), "ardupilot")  # type: ignore[arg-type]
    assert (answers["arm, armed already"], answers["disarm"]) == ("accepted", "accepted")
    assert answers["LOCAL_POSITION_NED at 20 Hz"] == "accepted, comes"
    assert answers["ODOMETRY at 20 Hz"] == "failed, does not come"
    assert answers["interval of message 9999"] == "failed" and answers["command USER_1"] == "unsupported"
    assert (answers["mode 99"], answers["mode after mode 99"]) == ("unsupported", 0)
    assert (answers["take off, disarmed"], answers["mode after that"]) == ("failed", 4)


@pytest.mark.parametrize(("at_once", "acceleration"), [(False, 1.0), (True, 1e4)])
def test_an_arducopter_of_ours_is_as_delivered_or_as_it_was_recorded(at_once: bool, acceleration: float) -> None:
    """`fly` needs the vehicle of the recorded data, which follows setpoints at once."""
    settings = AutopilotSettings("", "ardupilot", airborne=True, at_once=at_once, setpoint_timeout=0.2)
    autopilot = vehicle(settings, open_field(), 1)
    assert autopilot.flight.limits.horizontal_acceleration == acceleration
    assert autopilot.flight.limits.vertical_acceleration == acceleration
    assert autopilot.flight.limits.setpoint_timeout == 0.2


def test_where_there_is_no_real_one_the_variable_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("BRAKELINE_PX4", raising=False)
    with pytest.raises(sitl.NoAutopilot, match="BRAKELINE_PX4"):
        sitl.program("px4")

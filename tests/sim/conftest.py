"""Fixtures: a ground station with an embedded autopilot, on the ground and in the air, with both rule sets."""

import pytest

from brakeline.sim.autopilot.parameters import AT_ONCE
from tests.sim.station import Station


@pytest.fixture(params=["px4", "ardupilot"])
def station(request: pytest.FixtureRequest) -> Station:
    return Station(request.param)


@pytest.fixture(params=["px4", "ardupilot"])
def flying(request: pytest.FixtureRequest) -> Station:
    """Return a station whose vehicle flies and follows setpoints without a limit of acceleration."""
    station = Station(request.param, airborne=True, parameters=AT_ONCE[request.param])
    station.follow_setpoints()
    return station

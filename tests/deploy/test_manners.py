"""The same questions to every autopilot: an embedded one on the ground answers as its rules say."""

from __future__ import annotations

import pytest

from deploy.bench import sitl
from deploy.bench.manners import embedded, on_the_ground
from deploy.bench.station import Station
from messaging.links import open_link


def test_an_embedded_one_answers_on_the_ground() -> None:
    with embedded("ardupilot") as url:
        link = open_link(url)
        try:
            found = on_the_ground(Station(link, 1), "ardupilot")
        finally:
            link.close()
    assert (found["arm, armed already"], found["disarm"]) == ("accepted", "accepted")
    assert found["LOCAL_POSITION_NED at 20 Hz"] == "accepted, comes"
    assert found["interval of message 9999"] == "failed" and found["command USER_1"] == "unsupported"
    assert (found["mode 99"], found["mode after mode 99"]) == ("unsupported", 0)
    assert (found["take off, disarmed"], found["mode after that"]) == ("failed", 4)


def test_where_there_is_no_real_one_the_variable_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("BRAKELINE_PX4", raising=False)
    with pytest.raises(sitl.NoAutopilot, match="BRAKELINE_PX4"):
        sitl.program("px4")

"""Test which instance of a real autopilot starts."""

from contextlib import ExitStack
from pathlib import Path

import pytest

from benchmarks import sitl


@pytest.fixture(autouse=True)
def alone(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Hide the autopilots that run on this machine."""
    monkeypatch.setattr(sitl, "gettempdir", lambda: str(tmp_path))
    monkeypatch.setattr(sitl, "_taken", lambda kind, instance: instance == 5)


def test_those_that_start_in_the_same_second_have_numbers_of_their_own() -> None:
    with sitl._free("px4") as first, sitl._free("px4") as second, sitl._free("ardupilot") as other:
        assert len({first, second, 5}) == 3 and other == first
    with sitl._free("px4") as again:
        assert again == first


def test_when_there_are_too_many_it_is_said() -> None:
    with ExitStack() as running:
        numbers = {running.enter_context(sitl._free("px4")) for _ in sitl.INSTANCES[1:]}
        assert numbers == set(sitl.INSTANCES) - {5}
        with pytest.raises(sitl.NoAutopilot, match="no ports for more"):
            running.enter_context(sitl._free("px4"))

"""Questions that were logged before robots were files: the same is decided, to the last bit."""

from pathlib import Path

import pytest

from deploy.run.replay import replay

STORED = Path(__file__).parents[2] / "stored"


@pytest.mark.parametrize(("robot", "count"), [("ground", 400), ("quadrotor", 250)])
def test_stored_questions_are_decided_as_they_were(robot, count):
    found = replay(STORED / f"{robot}-before-files.mcap")
    assert (found.requests, found.identical, found.different) == (count, count, 0)

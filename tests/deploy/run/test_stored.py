"""Questions that were logged before robots were files: the same is decided.

Since then distances to far walls are worked out with less rounding, and the margin that is told is the true one: inputs
may differ in their last digits, the margin as it likes.
"""

from pathlib import Path

import pytest

from deploy.run.replay import replay

STORED = Path(__file__).parents[2] / "stored"
ROUNDING = 1e-9  # m/s, rad/s, m


@pytest.mark.parametrize(("robot", "count"), [("ground", 400), ("quadrotor", 250)])
def test_stored_questions_are_decided_as_they_were(robot, count):
    found = replay(STORED / f"{robot}-before-files.mcap").figures()
    assert (found["requests"], found["unanswered"]) == (count, 0)
    assert all(logged == now for logged, kinds in found["kinds"].items() for now in kinds)
    sizes = {name: field["largest"] for name, field in found["fields"].items() if name not in ("margin", "at_least")}
    assert all(size < ROUNDING for size in sizes.values()), sizes

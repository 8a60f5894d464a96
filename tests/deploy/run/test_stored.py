"""Questions that were logged before robots were files: the same is decided.

Since then distances to far walls are worked out with less rounding, and the margin that is told is the true one: inputs
may differ in their last digits, the margin as it likes. And of all rows those that decide are solved alone, more
exactly: that is left out in the first test.
"""

from pathlib import Path

import pytest

from deploy.run.replay import replay
from safety import solver

STORED = Path(__file__).parents[2] / "stored"
ROUNDING = 1e-9  # m/s, rad/s, m


@pytest.mark.parametrize(("robot", "count"), [("ground", 400), ("quadrotor", 250)])
def test_stored_questions_are_decided_as_they_were(robot, count, monkeypatch):
    monkeypatch.setattr(solver, "_by_few", lambda program: None)
    found = replay(STORED / f"{robot}-before-files.mcap").figures()
    assert (found["requests"], found["unanswered"]) == (count, 0)
    assert all(logged == now for logged, kinds in found["kinds"].items() for now in kinds)
    sizes = {name: field["largest"] for name, field in found["fields"].items() if name not in ("margin", "at_least")}
    assert all(size < ROUNDING for size in sizes.values()), sizes


def test_by_the_rows_that_decide_no_answer_is_lost():
    found = replay(STORED / "ground-before-files.mcap").figures()
    assert found["kinds"] == {"adjusted": {"adjusted": 171}, "allowed": {"allowed": 229}}
    assert found["fields"]["plan"]["largest"] < 1e-5
    kinds = replay(STORED / "quadrotor-before-files.mcap").figures()["kinds"]
    assert kinds["adjusted"] == {"adjusted": 126} and kinds["allowed"] == {"allowed": 102}
    assert kinds["failsafe"]["adjusted"] > 0 and sum(kinds["failsafe"].values()) == 22

"""Questions that were logged before robots were files: the same is decided.

Since then distances to far walls are worked out with less rounding, and the margin that is told is the true one: inputs
may differ in their last digits, the margin as it likes. And of all rows those that decide are solved alone, more
exactly: that is left out in the first test. The filter allows a verified proposal where no input keeps the clearance
margin; before, the solver's inaccuracy changed one of them by 5e-5 m/s.
"""

from pathlib import Path

import pytest

from brakeline.deploy.run.replay_run import replay
from brakeline.safety.filter import qp_solver

pytestmark = pytest.mark.fast

STORED = Path(__file__).parents[2] / "stored"
ROUNDING = 1e-9  # m/s, rad/s, m


@pytest.mark.parametrize(("robot", "count", "allowed_now"), [("ground", 400, 0), ("quadrotor", 250, 1)])
def test_stored_requests_are_decided_as_before(robot, count, allowed_now, monkeypatch):
    monkeypatch.setattr(qp_solver, "_by_few", lambda program: None)
    result = replay(STORED / f"{robot}-before-files.mcap")
    assert (result.requests, result.unanswered) == (count, 0)
    changed = {kinds: number for kinds, number in result.kinds.items() if kinds[0] != kinds[1]}
    assert changed == ({("adjusted", "allowed"): allowed_now} if allowed_now else {})
    sizes = {name: sorted(field) for name, field in result.fields.items() if name not in ("margin", "at_least")}
    assert sizes["input"][-1] < 1e-4
    rest = {name: field[: len(field) - allowed_now] for name, field in sizes.items()}
    assert all(size < ROUNDING for field in rest.values() for size in field), rest


def test_the_active_rows_alone_lose_no_decision():
    figures = replay(STORED / "ground-before-files.mcap").figures()
    assert figures["kinds"] == {"adjusted": {"adjusted": 171}, "allowed": {"allowed": 229}}
    assert figures["fields"]["plan"]["largest"] < 1e-5
    kinds = replay(STORED / "quadrotor-before-files.mcap").figures()["kinds"]
    assert kinds["adjusted"] == {"adjusted": 126} and kinds["allowed"] == {"allowed": 102}
    assert kinds["failsafe"]["adjusted"] > 0 and sum(kinds["failsafe"].values()) == 22

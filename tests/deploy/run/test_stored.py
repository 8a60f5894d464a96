"""Questions that were logged before robots were files: the same is decided.

Since then distances to far walls are worked out with less rounding, the margin that is told is the true one, and QPs
are solved exactly. The solver of that time was off by up to 1e-5 of an input's range where it converged. Where it did
not, it found no input for the quadrotor that could be verified.
"""

from pathlib import Path

import numpy as np
import pytest

from brakeline.deploy.run.replay_run import replay

pytestmark = pytest.mark.fast

STORED = Path(__file__).parents[2] / "stored"


def test_the_ground_robots_stored_requests_are_decided_as_before():
    result = replay(STORED / "ground-before-files.mcap")
    assert (result.requests, result.unanswered) == (400, 0)
    assert result.figures()["kinds"] == {"adjusted": {"adjusted": 171}, "allowed": {"allowed": 229}}
    assert max(result.fields["input"]) < 1e-5 and max(result.fields["plan"]) < 1e-5
    assert np.median(result.fields["input"]) < 1e-6


def test_the_quadrotors_stored_requests_brake_no_more_often_than_before():
    result = replay(STORED / "quadrotor-before-files.mcap")
    assert (result.requests, result.unanswered) == (250, 0)
    kinds = result.figures()["kinds"]
    assert kinds["adjusted"] == {"adjusted": 126} and kinds["allowed"] == {"allowed": 102}
    assert kinds["failsafe"]["adjusted"] > 0 and sum(kinds["failsafe"].values()) == 22

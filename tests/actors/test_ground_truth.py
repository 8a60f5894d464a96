"""The judge of a flight: its map is laid where the flight begins, and what the estimate drifts by counts against it."""

from __future__ import annotations

import numpy as np
import pytest

from brakeline.actors.mavlink.ground_truth import MavlinkGroundTruth
from brakeline.actors.mavlink.telemetry import GeoPosition

METRES = 0.0111195  # of latitude, a ten millionth of a degree


def at(north: float, altitude: float | None = 10.0) -> GeoPosition:
    return GeoPosition(round(north / METRES), 0, altitude, METRES)


def test_a_touch_is_judged_by_the_truth_and_counted_once() -> None:
    """A wall at 5 m north; the estimate drifts, and says that there is room."""
    truth = MavlinkGroundTruth(lambda position: 5.0 - position[1])
    for north in (0.0, 3.0, 4.9, 5.2, 5.4, 4.0, 5.1):
        estimate = np.array([1.0, 0.5 * north, 3.0])
        truth.take(at(north), estimate, np.zeros(3))
    assert truth.collisions == 2 and truth.least == pytest.approx(-0.4, abs=0.01)
    assert truth.clearance == pytest.approx(-0.1, abs=0.01)
    assert truth.worst == pytest.approx(2.7, abs=0.01)
    assert truth.state is not None and truth.state[:3] == pytest.approx([1.0, 5.1, 3.0], abs=0.02)


def test_a_height_that_is_not_told_is_the_estimates() -> None:
    truth = MavlinkGroundTruth(lambda position: float(position[2]))
    for height in (3.0, 2.0):
        truth.take(at(0.0, None), np.array([0.0, 0.0, height]), np.zeros(3))
    assert truth.clearance == pytest.approx(2.0)

"""What each range of a laser scan says, and which scans contradict themselves."""

import math

import numpy as np
import pytest

from brakeline.actors.ros2.laser_beams import read
from brakeline.errors import BadScan
from tests.actors.ros2.test_ros_inputs import BEAMS, scan_of

HIT, FREE, TOO_NEAR, NOTHING = "hit", "free", "too near", "nothing"


def meaning(value, **more):
    """Return what a range between hits at 1 m says, with the other beams as they were."""
    ranges = np.full(BEAMS, 1.0)
    ranges[90] = value
    beams = read(scan_of(ranges, **more), more.pop("zero_is_free", False))
    others = np.arange(BEAMS) != 90
    assert beams.known[others].all() and not beams.too_near[others].any() and (beams.ranges[others] == 1.0).all()
    if beams.too_near[90]:
        assert not beams.known[90] and math.isnan(beams.ranges[90])
        return TOO_NEAR
    if not beams.known[90]:
        assert math.isnan(beams.ranges[90])
        return NOTHING
    return FREE if beams.ranges[90] == np.float32(3.5) and value != np.float32(3.5) else HIT


@pytest.mark.parametrize(
    ("value", "says"),
    [
        (0.12, HIT),
        (1.7, HIT),
        (3.5, HIT),
        (math.inf, FREE),
        (-math.inf, TOO_NEAR),
        (0.119, TOO_NEAR),
        (1e-6, TOO_NEAR),
        (3.501, NOTHING),
        (65.533, NOTHING),
        (3e38, NOTHING),
        (math.nan, NOTHING),
        (0.0, NOTHING),
        (-0.0, NOTHING),
        (-1.0, NOTHING),
        (-3e38, NOTHING),
    ],
)
def test_what_a_range_says_by_rep_117(value, says):
    """A range above range_max was free space: a lidar that sees 65.533 m in an error drove into what it missed."""
    assert meaning(value, range_min=np.float32(0.12)) == says


def test_zero_is_free_only_if_the_settings_say_so():
    scan = scan_of(np.zeros(BEAMS))
    free = read(scan, zero_is_free=True)
    assert free.known.all() and (free.ranges == 3.5).all()
    assert not read(scan).known.any() and not read(scan_of(np.zeros(BEAMS), range_min=0.0)).known.any()


def test_ranges_above_range_max_are_counted():
    assert read(scan_of([1.0, 3.6, math.inf, math.nan, 65.5])).beyond == 2


@pytest.mark.parametrize("sign", [-1.0, 1.0])
@pytest.mark.parametrize("off", [-2.4, -1.0, 0.0, 1.0, 2.4])
def test_an_end_that_counts_some_beams_more_or_less_is_accepted(sign, off):
    """Of a YDLIDAR with 720 beams, angle_max is one increment off; of velodyne_laserscan with 897 beams, 1.6."""
    step = sign * 2.0 * math.pi / BEAMS
    for turns in (-1, 0, 1):
        end = -math.pi + (BEAMS - 1 + off) * step + 2.0 * math.pi * turns
        scan = scan_of(np.full(BEAMS, 1.0), angle_min=-math.pi, angle_increment=step, angle_max=end)
        assert len(read(scan).angles) == BEAMS


@pytest.mark.parametrize(
    "wrong",
    [
        {"angle_min": 0.0, "angle_max": math.pi},  # 0.5° apart, and the increment says 1°
        {"angle_min": -math.pi, "angle_max": math.pi, "angle_increment": 0.017},  # rounded: the last one is 9° off
        {"angle_min": 0.0, "angle_max": 2.0 * math.pi + 0.05},
        {"angle_min": 0.0, "angle_max": math.radians(355.0)},
        {"angle_min": 0.0, "angle_max": 358.5},  # degrees
    ],
)
def test_an_end_that_contradicts_the_increment_is_refused_with_the_numbers(wrong):
    with pytest.raises(BadScan, match=r"angle_max is [\d.]+ rad, but 360 beams from .* apart, end at [\d.]+ rad"):
        read(scan_of(np.full(BEAMS, 1.0), **wrong))


@pytest.mark.parametrize(
    "wrong",
    [
        {"ranges": np.zeros(1, np.float32)},
        {"ranges": np.zeros(20_000, np.float32)},
        {"angle_increment": 0.0},
        {"angle_increment": 1e-9},
        {"angle_increment": math.nan},
        {"angle_increment": 1.0},  # degrees
        {"angle_min": math.inf},
        {"angle_max": math.nan},
        {"angle_max": -math.inf},
        {"range_min": -1.0},
        {"range_max": 0.0},
        {"range_max": math.inf},
        {"time_increment": math.nan},
    ],
)
def test_an_invalid_scan_is_refused(wrong):
    with pytest.raises(BadScan):
        read(scan_of(np.full(BEAMS, 1.0), **wrong))

"""In random scenes with pose errors, memory shows only free space to be free."""

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from brakeline.errors import BadRequest
from brakeline.messaging.obstacle import Shapes
from brakeline.messaging.range_image import RangeImage
from brakeline.messaging.scan import MAX_SCAN_AGE, Scan
from brakeline.safety.perception.image_coverage import has_blind_directions, unseen_poles
from brakeline.safety.perception.image_memory import ImageMemory, memory_of
from brakeline.safety.perception.image_memory import filled as filled_from_memory
from brakeline.safety.perception.scan_free_space import gaps
from brakeline.safety.perception.visibility_memory import FanMemory
from tests.robots import GROUND
from tests.safety.test_scan_free_space import FAN, FAR, WIDTH, cast, scene

BODY = 0.02
BEHIND = np.abs(FAN) > math.radians(150.0)  # beams that measure nothing


def taken(obstacles, pose, rng, error=0.01, turn=0.02, speed=0.0):
    """Return a scan from a true pose, blind behind, with a measured pose that is wrong within its bounds."""
    ranges = cast(obstacles, np.array(pose[:2]), FAN + pose[2])
    ranges[BEHIND] = 0.0
    off = rng.normal(size=2)
    off *= error / np.linalg.norm(off)
    seen = (pose[0] + off[0], pose[1] + off[1], pose[2] + rng.uniform(-turn, turn))
    known = {"position_error": error, "heading_error": turn, "range_error": 0.005}
    return Scan(ranges, FAN, seen, far=FAR, least_width=WIDTH, speed=speed, **known)


def without_beams_behind(scan):
    """Return the scan of a sensor that has no beams where this one's measure nothing."""
    return replace(scan, ranges=scan.ranges[~BEHIND], angles=scan.angles[~BEHIND])


@settings(max_examples=8, deadline=None)
@given(st.integers(0, 100_000), st.booleans())
def test_space_that_memory_shows_to_be_free_is_free(seed, cut):
    rng = np.random.default_rng(seed)
    obstacles = scene(rng, 8)
    shapes = Shapes.of(obstacles, 2)
    memory, pose, remembered = FanMemory(BODY), np.array([0.0, 0.0, rng.uniform(-3, 3)]), 0
    for _ in range(12):
        scan = without_beams_behind(taken(obstacles, pose, rng)) if cut else taken(obstacles, pose, rng)
        filled = memory.fill(scan, 0.2)
        measured = np.isin(filled.angles, scan.angles[scan.valid_beams])
        new = ~measured & filled.valid_beams
        remembered += int(new.sum())
        true = cast(obstacles, pose[:2], filled.angles[new] + pose[2])
        assert (filled.ranges[new] - scan.range_error <= true + 1e-9).all()
        assert np.array_equal(filled.ranges[measured], scan.ranges[scan.valid_beams])
        ahead = pose + 0.05 * np.array([math.cos(pose[2]), math.sin(pose[2]), 0.0])
        if shapes.distance(ahead[:2]).min() > BODY:
            pose = ahead
        pose[2] += rng.uniform(-0.3, 0.3)
    assert remembered > 0


def test_a_scan_keeps_its_beams_where_they_leave_nothing_out():
    for angles in (FAN[::10], np.radians([0.0, 10.0, 350.0]), np.linspace(0.0, 6.0, 1000)):
        scan = Scan(np.ones(len(angles)), angles, (0.0, 0.0, 0.0))
        added = len(FanMemory(BODY).fill(scan, 0.2).angles) - len(angles)
        assert added == (340 // 3 if len(angles) == 3 else 0), "at most 3° apart, and 1000 beams in all"


def empty(x=0.0, speed=0.0):
    """Return a scan of empty space, blind behind."""
    return taken([], (x, 0.0, 0.0), np.random.default_rng(0), speed=speed)


@pytest.mark.parametrize("speed", [0.0, 1.6])
@pytest.mark.parametrize("cut", [False, True])
def test_memory_fills_a_blind_sector_after_driving_ahead_and_fades_in_a_moving_world(speed, cut):
    memory = FanMemory(0.105)
    for k in range(20):
        scan = empty(0.05 * k, speed)
        filled = memory.fill(without_beams_behind(scan) if cut else scan, 0.2)
    if speed:
        assert not filled.valid_beams[np.abs(filled.angles) > math.radians(150.5)].any()
    else:
        angles, _, free = gaps(filled)
        assert free[np.abs(angles) > math.pi - 0.3].min() > 0.3


BLINDED = replace(empty(speed=1.2), ranges=np.zeros(len(FAN)))


def test_without_a_new_scan_the_last_one_ages():
    memory = FanMemory(0.105)
    assert not len(memory.fill(None, 0.2).ranges), "before the first scan, nothing is free"
    filled = memory.fill(empty(speed=1.2), 0.2)
    memory.later(0.2)  # a period without a call of `fill`
    again = memory.fill(None, 0.2)
    assert np.array_equal(again.ranges, filled.ranges) and again.age == pytest.approx(filled.age + 0.4)
    assert memory.fill(None, 0.2).age == pytest.approx(filled.age + 0.6)
    for _ in range(10):
        memory.fill(None, 0.2)
    assert not memory.fill(BLINDED, 0.2).valid_beams.any(), "movers may have entered all remembered space"


def test_at_the_start_only_a_ring_around_the_body_is_free_and_only_if_the_first_scan_comes_at_once():
    """Otherwise, a person may have walked in."""
    filled = FanMemory(0.105).fill(empty(), 0.0)
    behind = filled.ranges[BEHIND] - filled.range_error
    assert (behind > 0.17).all() and (behind <= 0.205).all()
    memory = FanMemory(0.105)
    assert memory.fill(BLINDED, 0.2).valid_beams.any(), "at once"
    memory.reset()
    for _ in range(3):
        memory.fill(None, 0.2)
    assert not memory.fill(BLINDED, 0.2).valid_beams.any()


def test_the_place_of_the_start_has_the_error_of_the_first_pose():
    """A later pose may be known better, as after the odometry's drift is added to a late scan's error."""
    first, memory = replace(empty(), position_error=0.08), FanMemory(0.105)
    memory.fill(first, 0.2)
    behind = memory.fill(replace(empty(), position_error=0.0), 0.2).ranges[BEHIND] - first.range_error
    assert (behind <= 0.125 + 1e-9).all() and (behind > 0.1).all()


def test_an_episode_that_begins_without_a_scan_frees_nothing_if_the_robot_has_a_sensor():
    memory = memory_of(GROUND)
    assert filled_from_memory(memory, {}, 0.2) is None, "no scan has ever come"
    filled_from_memory(memory, {"scan": empty()}, 0.2)
    memory.reset()
    assert not filled_from_memory(memory, {}, 0.2).valid_beams.any()


def test_a_wrong_argument_says_which_one_is_right():
    with pytest.raises(TypeError, match=r"such as `filter\.robot` or `client\.robot`, not a FanMemory"):
        memory_of(memory_of(GROUND))
    with pytest.raises(TypeError, match=r'such as \{"scan": scan\}, not a Scan'):
        filled_from_memory(memory_of(GROUND), empty(), 0.2)


@pytest.mark.parametrize("elapsed", [-2.4, -1e9, math.nan, math.inf])
@pytest.mark.parametrize("speed", [0.0, 0.5])
def test_after_a_jump_of_the_clock_everything_in_memory_is_old(elapsed, speed):
    memory = FanMemory(0.105)
    memory.fill(empty(speed=speed), 0.2)
    for scan in (None, empty(speed=speed)):
        with pytest.raises(BadRequest, match="elapsed is") as caught:
            memory.fill(scan, elapsed)
        assert caught.value.field == "elapsed"
    assert memory.fill(None, 0.2).age > MAX_SCAN_AGE
    fresh = memory.fill(replace(BLINDED, speed=speed), 0.2)
    assert fresh.age == 0.0 and fresh.valid_beams.any() == (speed == 0.0), "in a world that stands still, it stays free"


@pytest.mark.parametrize("memory", [FanMemory(0.105), ImageMemory(0.3)])
def test_overwriting_the_callers_array_does_not_change_the_memory(memory):
    beams = np.full(36, 0.5) if isinstance(memory, FanMemory) else np.full((30, 60), 0.5)
    angles, state = np.linspace(-math.pi, math.pi, 36, endpoint=False), np.zeros(5)
    where = state[:3]  # moves with the robot
    memory.fill(Scan(beams, angles, where) if beams.ndim == 1 else RangeImage(beams, where), 0.2)
    beams[:] = 3.0
    angles += 1.0
    state += 1.0
    last = memory.fill(None, 0.2)
    assert (last.ranges == 0.5).all()
    assert beams.ndim == 2 or last.angles[0] == -math.pi
    assert (last.pose if beams.ndim == 1 else last.at) == (0.0, 0.0, 0.0)
    last.ranges[:] *= 1000.0  # for a display in mm
    again = memory.fill(None, 0.2)
    again.ranges[:] *= 1000.0
    assert (memory.fill(None, 0.2).ranges == 0.5).all()
    memory.reset()
    memory.fill(None, 0.2).ranges[:] = 3.0
    assert not memory.nothing.valid_beams.any()


@pytest.mark.parametrize("low", [-90.0, -89.0, -45.0])
@pytest.mark.parametrize("high", [90.0, 89.0, 45.0])
def test_the_first_image_without_beams_up_or_down_says_that_nothing_will_fly(low, high, caplog):
    """A ring of depth cameras sees a belt. An aircraft with it braked for ever, and nothing said why."""
    image = RangeImage(
        np.full((round(high - low) // 2 + 1, 180), 20.0),
        (0.0, 0.0, 2.0),
        low=math.radians(low),
        high=math.radians(high),
    )
    sides = [f"above {high:.0f}°"] * (high < 50.0) + [f"below {low:.0f}°"] * (low > -50.0)
    assert bool(sides) == bool(unseen_poles(image)) == has_blind_directions(image)
    memory = ImageMemory(0.3)
    for _ in range(2):
        memory.fill(image, 0.1)
    warnings = [record.getMessage() for record in caplog.records]
    assert warnings == ([f"the robot will not fly: {unseen_poles(image)}"] if sides else [])
    assert not sides or f"no beams {' and '.join(sides)}, so" in unseen_poles(image)

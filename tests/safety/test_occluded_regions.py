"""Half-spaces from range images keep off every obstacle, for any pose error within its bounds."""

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial import KDTree

from brakeline.messaging.obstacle import Obstacle, rotate
from brakeline.messaging.range_image import RangeImage, directions
from brakeline.safety.perception.image_coverage import GridWindow, patch_free_ranges
from brakeline.safety.perception.image_memory import DISTANCES, ImageMemory, _StoredImage
from brakeline.safety.perception.occluded_regions import (
    PLANES,
    PlanBoxes,
    _patches,
    half_spaces,
    occluded_regions,
)
from tests.messaging.test_range_image import (
    COLUMNS,
    EDGE,
    FAR,
    GRID,
    RINGS,
    WIDTH,
    free_towards,
    hall,
    solid,
    taken,
)
from tests.safety.ray_casting import cast

BODY, ORIGIN = 0.2, np.zeros(3)
FACES = np.vstack([np.eye(3), -np.eye(3)])  # normals of a box


def room(size=2.0, last=2.4):
    return PlanBoxes(np.array([-size, size])[:, None, None].repeat(3, axis=2), last)


def clear(**more):
    more = {"ranges": np.full((RINGS, COLUMNS), FAR), "far": FAR} | more
    return RangeImage(at=(0.0, 0.0, 0.0), low=-EDGE, high=EDGE, **more)


def planes(image, nominal, boxes=None, keep_off=0.0, measured=ORIGIN):
    """Return the half-spaces that keep a body off the image's shadows on a path from the origin."""
    regions = occluded_regions(image, room() if boxes is None else boxes, BODY, ORIGIN)
    return half_spaces(regions, ORIGIN, nominal, keep_off, measured, 0.2)


def bounded(seed, dropped):
    """Return half-spaces in a hall for the largest pose errors, and the solid points within reach.

    Returns normals (rows, 6, 3), offsets (rows, 6) and points (n, 3).
    """
    rng = np.random.default_rng(seed)
    obstacles = hall(rng)
    image = taken(rng, obstacles, 0.02, position_error=0.03, angle_error=0.01)
    image.ranges[rng.random(image.ranges.shape) < dropped] = 0.0
    off = rng.normal(size=3)
    points = solid(obstacles, rng) + 0.03 * off / np.linalg.norm(off)
    turn = rng.uniform(-0.01, 0.01)
    points = rotate(points, turn)
    nominal = np.cumsum(rng.uniform(-0.3, 0.3, (6, 3)), axis=0)
    normals, offsets = planes(image, nominal)
    return normals, offsets, points[(np.abs(points) < 2.0 + BODY / math.sqrt(3.0)).all(axis=1)]


@settings(max_examples=12)
@given(st.integers(0, 100_000), st.sampled_from([0.0, 0.1]))
def test_every_point_within_reach_is_beyond_some_half_space(seed, dropped):
    normals, offsets, near = bounded(seed, dropped)
    assert len(FACES) <= len(normals) <= PLANES + len(FACES) and normals.shape[1:] == (6, 3)
    if np.isneginf(offsets).all():  # so much is not seen that even the start may be occupied
        return
    for k in range(6):
        used = normals[:, k].any(axis=1)
        beyond = near @ normals[used, k].T >= offsets[used, k] - 1e-6
        outside = beyond[:, : -len(FACES)].any(axis=1) | (np.abs(near) >= 2.0).any(axis=1)
        assert outside.all()


@settings(max_examples=12)
@given(st.integers(0, 100_000))
def test_no_body_in_the_boxes_of_a_period_touches_an_obstacle(seed):
    """The boxes grow with time, as those of plans do. A period omits the shadows out of its reach."""
    rng = np.random.default_rng(seed)
    obstacles = hall(rng)
    image, tree = taken(rng, obstacles, 0.02), KDTree(solid(obstacles, rng))
    nominal = np.cumsum(rng.uniform(-0.3, 0.3, (6, 3)), axis=0)
    size = np.linspace(0.05, 1.0, 7)[:, None]
    ways = np.vstack([ORIGIN, nominal]) + rng.uniform(-0.5, 0.5, (7, 3)) * size
    boxes = np.stack([ways - size, ways + size])
    normals, offsets = planes(image, nominal, PlanBoxes(boxes, 2.4), BODY)
    if np.isneginf(offsets).all():
        return
    for k in range(6):
        at = rng.uniform(boxes[0, k : k + 2].min(axis=0), boxes[1, k : k + 2].max(axis=0), (300, 3))
        free = (at @ normals[:, k].T <= offsets[:, k]).all(axis=1)
        assert tree.query(at[free])[0].min(initial=np.inf) >= BODY - 1e-6


@pytest.mark.parametrize("end", [0, 2])
def test_a_box_with_nan_leaves_nothing_free(end):
    boxes = room().boxes.repeat(3, axis=1)
    boxes[1, end, 1] = np.nan
    seen = replace(occluded_regions(clear(), room(), BODY, ORIGIN), room=PlanBoxes(boxes, 2.4))
    assert np.isneginf(half_spaces(seen, ORIGIN, np.zeros((2, 3)), BODY, ORIGIN, 0.2)[1]).all()


def test_with_all_beams_known_the_start_is_rarely_occupied():
    assert sum(np.isneginf(bounded(seed, 0.0)[1]).all() for seed in range(8)) <= 1


@pytest.mark.parametrize("seed", range(2))
def test_all_space_that_is_not_shown_to_be_free_is_beyond_some_half_space(seed, monkeypatch):
    """This holds for all space behind the free range of every patch, if no gap is given up."""
    monkeypatch.setattr("brakeline.safety.perception.occluded_regions.GIVE", 0.0)
    monkeypatch.setattr("brakeline.safety.perception.occluded_regions.PLANES", 1500)
    rng = np.random.default_rng(seed)
    image = clear(ranges=np.repeat(np.repeat(rng.uniform(1.5, 6.0, (RINGS // 5, COLUMNS // 5)), 5, 0), 5, 1))
    nominal = np.cumsum(rng.uniform(-0.1, 0.1, (3, 3)), axis=0)
    normals, offsets = planes(image, nominal)
    points = rng.uniform(-2.0, 2.0, (20_000, 3))
    free, far = free_towards(image, points)
    hidden = points[far >= free]
    assert len(hidden) > 100
    for k in range(3):
        assert (hidden @ normals[:-6, k].T >= offsets[:-6, k] - 1e-6).any(axis=1).all()


def test_half_spaces_keep_the_body_off_and_recede_with_time_from_what_may_move():
    wall = [Obstacle("box", (2.0, 0.0, 0.0), (2.0, 20.0, 20.0))]
    rng = np.random.default_rng(0)
    nominal = np.zeros((3, 3))
    still, moving = (taken(rng, wall, speed=s, age=0.1) for s in (0.0, 0.5))
    ahead = planes(still, nominal)[1][0]
    assert 0.8 < ahead[0] <= 1.0
    shrunk = planes(still, nominal, None, BODY, np.full(3, 0.01))[1][0]
    assert (ahead - shrunk >= BODY + 0.01 - 0.02).all()
    lost = ahead - planes(moving, nominal)[1][0]
    assert np.allclose(lost, 0.5 * (0.1 + 0.2 * np.arange(1, 4)), atol=0.02)


def test_an_attitude_error_displaces_a_sensor_on_a_mast():
    """A wall is 0.5 m ahead of the robot, whose true tilt is the largest attitude error."""
    error, ahead, rings, columns = 0.05, 0.5, 90, 180
    edge = 0.5 * math.pi * (1.0 - 1.0 / rings)
    tilt = np.array([[math.cos(error), 0, math.sin(error)], [0, 1, 0], [-math.sin(error), 0, math.cos(error)]])
    mount = (0.0, 0.0, -2.0)
    ways = directions(np.linspace(-edge, edge, rings), columns) @ tilt.T
    at = tilt @ mount
    towards = np.maximum(ways[..., 0], 1e-9)
    ranges = np.minimum((ahead - at[0]) / towards, FAR)
    known = {"far": FAR, "range_error": 0.0, "angle_error": error, "least_width": 5.0}
    image = RangeImage(ranges, (0.0, 0.0, 0.0), low=-edge, high=edge, mount=mount, **known)
    nominal = np.linspace(0.0, 1.0, 9)[1:, None] * np.asarray(mount)
    seen = occluded_regions(image, room(4.0, 1.0), 0.0, ORIGIN)
    normals, offsets = half_spaces(seen, ORIGIN, nominal, 0.0, ORIGIN, 0.2)
    assert np.isfinite(offsets).all()
    across = np.linspace(-0.3, 0.3, 31)
    wall = np.array([[ahead, y, mount[2] + z] for y in across for z in across])
    beyond = wall @ normals[: -len(FACES), -1].T >= offsets[: -len(FACES), -1]
    assert beyond.any(axis=1).all()


@pytest.mark.parametrize("low", [-EDGE, -0.5 * math.pi, -0.9])
def test_no_direction_is_farther_from_its_patch_than_half_a_meshes_diagonal(low):
    image = RangeImage(np.ones((RINGS, COLUMNS)), (0.0, 0.0, 0.0), low=low, high=-low)
    grid, _ = patch_free_ranges(image)
    middles = _patches(grid)[1].T
    ways = np.random.default_rng(0).normal(size=(3000, 3))
    ways /= np.linalg.norm(ways, axis=1, keepdims=True)
    nearest = np.arccos(np.clip((ways @ middles.T).max(axis=1), -1.0, 1.0))
    assert nearest.max() <= grid.half_diagonal + 1e-6


def test_in_empty_space_only_the_boxes_faces_remain_and_an_image_without_known_beams_leaves_nothing_free():
    normals, offsets = planes(clear(), np.zeros((2, 3)), keep_off=BODY)
    assert np.array_equal(normals[:, 0], FACES) and (offsets == 2.0).all()
    for image in (clear(ranges=np.zeros((RINGS, COLUMNS))), clear(range_error=FAR)):
        assert (planes(image, np.full((2, 3), 0.1), keep_off=BODY)[1].min(axis=0) < 0.0).all()


def test_a_path_through_a_shadow_keeps_the_half_spaces_from_before_it():
    wall = [Obstacle("box", (2.0, 0.0, 0.0), (2.0, 20.0, 20.0))]
    nominal = np.array([[0.5, 0.0, 0.0], [1.5, 0.0, 0.0], [2.5, 0.0, 0.0]])
    normals, offsets = planes(taken(np.random.default_rng(0), wall), nominal, room(4.0))
    assert (normals[:, 1:] == normals[:, :1]).all() and (offsets[:, 1:] == offsets[:, :1]).all()
    assert (nominal[1] @ normals[:, 1].T > offsets[:, 1]).any()


@settings(max_examples=12)
@given(st.integers(0, 100_000), st.floats(0.02, 1.2))
def test_a_window_holds_all_beams_within_its_angle(seed, within):
    rings, columns = 12, 24
    elevations = np.linspace(-0.5 * math.pi, 0.5 * math.pi, rings)
    values = np.random.default_rng(seed).random((rings, columns), np.float32)
    ways = directions(elevations, columns).reshape(-1, 3)
    near = ways @ ways.T >= math.cos(within) + 1e-9
    least = np.where(near, values.ravel(), np.inf).min(axis=1).reshape(rings, columns)
    window = GridWindow.of(columns, elevations, elevations[1] - elevations[0], within)
    assert (window.minimum(values) <= least).all()


# --- memory ----------------------------------------------------------------------------------------------


BEHIND = np.abs(np.arctan2(GRID[..., 1], GRID[..., 0])) > math.radians(150.0)  # beams that measure nothing


@settings(max_examples=5)
@given(st.integers(0, 100_000))
def test_space_that_memory_shows_to_be_free_is_free(seed):
    rng = np.random.default_rng(seed)
    obstacles = hall(rng)
    memory, at, remembered = ImageMemory(0.3 - ImageMemory.START), np.zeros(3), 0
    for _ in range(6):
        off = rng.normal(size=3)
        seen = tuple(at + 0.02 * off / np.linalg.norm(off))
        ranges = np.where(BEHIND, 0.0, cast(obstacles, at, GRID, FAR))
        known = {"far": FAR, "range_error": 0.005, "position_error": 0.02, "angle_error": 0.01, "least_width": WIDTH}
        image = RangeImage(ranges, seen, low=-EDGE, high=EDGE, **known)
        filled = memory.fill(image, 0.2)
        new = ~image.valid_beams & filled.valid_beams
        remembered += int(new.sum())
        if new.any():
            assert (filled.ranges[new] - image.range_error <= cast(obstacles, at, GRID[new], FAR) + 1e-6).all()
        assert np.array_equal(filled.ranges[image.valid_beams], image.ranges[image.valid_beams])
        step = np.array([0.55, 0.0, 0.0])
        at = at + step if cast(obstacles, at, np.array([1.0, 0.0, 0.0]), FAR) > 0.8 else at - 0.3 * step
    assert remembered > 0


def test_memory_fills_a_blind_sector_after_flying_ahead_and_a_ring_at_the_start_and_fades_in_a_moving_world():
    def remembered(**more):
        memory, image = ImageMemory(0.3), clear(ranges=np.where(BEHIND, 0.0, FAR), **more)
        return [memory.fill(replace(image, at=(0.6 * k, 0.0, 0.0)), 0.2) for k in range(8)]

    still = remembered(position_error=0.02, angle_error=0.01)
    first, last = (image.ranges[RINGS // 2, COLUMNS // 2] for image in (still[0], still[-1]))
    assert 0.6 < first <= 1.0 + still[0].range_error and last > 1.5
    assert not remembered(speed=3.0)[-1].valid_beams[BEHIND].any()


@pytest.mark.parametrize(("error", "free"), [(0.0, True), (0.03, False)])
def test_an_attitude_error_counts_at_the_distance_from_the_sensor_now(error, free):
    """The point is 0.4 m from where an image showed 0.6 m to be free, and 3.6 m from the sensor now."""
    before = _StoredImage(clear(ranges=np.full((RINGS, COLUMNS), 0.6)))
    now = replace(clear(angle_error=error), at=(4.0, 0.0, 0.0))
    points = np.full((len(DISTANCES), 1, 3), [0.4, 0.0, 0.0])
    assert ImageMemory(BODY)._shown_free(before, 0.0, points, now)[0, 0] == free

"""What the compiled loops over shadows say, line by line: a shadow holds its patch, and is beyond some half-space."""

import math
import subprocess
import sys

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from brakeline.messaging.obstacle import FARTHEST
from brakeline.messaging.range_image import RangeImage
from brakeline.safety.perception.image_coverage import patch_free_ranges
from brakeline.safety.perception.kernels.occlusion_kernels import rooms, supporting
from brakeline.safety.perception.kernels.shadow_kernels import complete, nearest_of_patches, rounding
from brakeline.safety.perception.occluded_regions import (
    OccludedRegions,
    PlanBoxes,
    _patches,
    half_spaces,
    occluded_regions,
)
from tests.messaging.test_range_images import COLUMNS, EDGE, RINGS
from tests.safety.test_shadows import NOTHING, room

TURN = (math.cos(0.4), 0.3 * math.sin(0.4), 0.0, math.sqrt(1.0 - 0.09) * math.sin(0.4))  # a quaternion


def scattered(seed, at=(0.2, -0.1, 0.3)):
    """An image of blocks in random distances, by a sensor that is turned."""
    rng = np.random.default_rng(seed)
    ranges = np.repeat(np.repeat(rng.uniform(1.0, 6.0, (RINGS // 5, COLUMNS // 5)), 5, 0), 5, 1)
    known = {"low": -EDGE, "high": EDGE, "far": 8.0, "position_error": 0.03, "angle_error": 0.01}
    return RangeImage(ranges, at, TURN, **known)


@pytest.mark.parametrize("at", [(0.2, -0.1, 0.3), (3.4, -0.1, 0.3)], ids=["inside", "outside"])
@settings(max_examples=20)
@given(seed=st.integers(0, 100_000))
def test_a_shadow_holds_all_of_its_patch_that_comes_into_the_room_whatever_the_errors(at, seed):
    """Also by a sensor that is not where the robot may be: what an old image shows."""
    rng, image = np.random.default_rng(seed), scattered(seed, at)
    origin = np.array([0.5, 0.3, -0.2])
    lines = occluded_regions(image, room(2.0, 1.0), 0.2, origin).lines.astype(float)
    lines[:3] += origin[:, None]
    grid, free = patch_free_ranges(image)
    together, middles = _patches(grid)
    middles = middles.T
    free = np.concatenate(
        [np.minimum.reduceat(ring, np.arange(0, COLUMNS, each)) for ring, each in zip(free, together, strict=True)]
    )
    which = rng.integers(len(middles), size=4000)
    aside = rng.normal(size=(4000, 3))
    aside -= np.einsum("nd,nd->n", aside, middles[which])[:, None] * middles[which]
    aside *= math.tan(grid.half_diagonal + image.angle_error) / np.linalg.norm(aside, axis=1, keepdims=True)
    ways = middles[which] + aside
    ways /= np.linalg.norm(ways, axis=1, keepdims=True)
    off = rng.normal(size=(4000, 3))
    off *= image.position_error / np.linalg.norm(off, axis=1, keepdims=True)
    points = image.sensor() + (free[which] * rng.uniform(1.0, 3.0, 4000))[:, None] * (ways @ image.turn.T) + off
    inside = (np.abs(points) < 2.0).all(axis=1)
    assert inside.sum() > 50
    for point, patch in zip(points[inside][:100], which[inside][:100], strict=True):
        (line,) = np.flatnonzero(lines[3:6].T @ (image.turn @ middles[patch]) > 1.0 - 5e-7)
        near, along, (length, about_near, about_far) = lines[:3, line], lines[3:6, line], lines[6:9, line]
        share = np.linspace(0.0, 1.0, 400)
        there = near + (share * length)[:, None] * along
        about = about_near + share * (about_far - about_near)
        assert (np.linalg.norm(point - there, axis=1) <= about + 1e-3).any(), "in the hull of the balls"


@settings(max_examples=30)
@given(st.integers(0, 100_000), st.integers(2, 40), st.integers(1, 30))
def test_a_patch_is_as_near_as_the_nearest_of_its_beams(seed, rings, columns):
    """Also where a patch near a pole would be wider than the ring is round."""
    rng = np.random.default_rng(seed)
    free, together = rng.random((rings, columns), np.float32), rng.integers(1, 3 * columns, rings)
    rings_ = zip(free, together, strict=True)
    expected = np.concatenate([np.minimum.reduceat(ring, np.arange(0, columns, each)) for ring, each in rings_])
    assert np.array_equal(nearest_of_patches(free, together, len(expected)), expected)


@settings(max_examples=30)
@given(st.integers(0, 100_000), st.integers(1, 60), st.sampled_from([0.0, 0.05]))
def test_every_shadow_is_beyond_some_half_space_of_every_chord(seed, n, give):
    rng = np.random.default_rng(seed)
    near, along = rng.normal(size=(3, n)), rng.normal(size=(3, n))
    near *= rng.uniform(1.5, 3.0, n) / np.linalg.norm(near, axis=0)
    along /= np.linalg.norm(along, axis=0)
    lines = np.vstack([near, along, rng.uniform(0.0, 3.0, n), rng.uniform(0.0, 0.1, n), rng.uniform(0.1, 0.3, n)])
    start = rng.uniform(-0.2, 0.2, 3)
    chords, room = rng.uniform(-0.3, 0.3, (3, 2, 3)), rng.random((3, n), np.float32)
    told = from_(lines, start)
    normals, levels = supporting(told, chords, room, np.full(3, np.inf), 0.2, n, give, FARTHEST, 1e-4)
    ends = near - start[:, None], near - start[:, None] + lines[6] * along
    for group in range(3):
        used = levels[group] < FARTHEST
        least = [normals[group, used] @ end - about for end, about in zip(ends, lines[7:], strict=True)]
        assert (np.minimum(*least) >= levels[group, used, None] - 1e-9).any(axis=0).all()
        assert np.allclose(np.linalg.norm(normals[group, used], axis=1), 1.0)


def test_where_half_spaces_do_not_suffice_nothing_is_free():
    lines = np.zeros((9, 2))
    lines[0], lines[3], lines[6] = [-1.0, 1.0], [-1.0, 1.0], 1.0  # one on either side
    chords, room = np.zeros((1, 2, 3)), np.ones((1, 2), np.float32)
    told, everywhere = from_(lines, NOTHING), np.full(1, np.inf)
    assert np.isfinite(supporting(told, chords, room, everywhere, 0.0, 2, 0.0, FARTHEST, 1e-4)[1]).all()
    assert np.isneginf(supporting(told, chords, room, everywhere, 0.0, 1, 0.0, FARTHEST, 1e-4)[1]).all()
    assert supporting(told, chords, room, np.full(1, 0.9), 0.0, 1, 0.0, FARTHEST, 1e-4)[1].size == 0


def from_(lines, origin):
    """Lines (9, n), world, as they are told from an origin (3,)."""
    told = np.empty((11, lines.shape[1]), np.float32)
    with np.errstate(over="ignore"):
        told[:3], told[3:9] = lines[:3] - origin[:, None], lines[3:]
    complete(told)
    return told


def along_x(step, half):
    """Ends (N+1, 3) so far apart, and boxes (2, N+1, 3) about them, so wide to either side (N+1,)."""
    half = np.asarray(half)[:, None] * np.ones(3)
    ends = np.zeros((len(half), 3))
    ends[:, 0] = step * np.arange(len(half))
    return ends, np.stack([ends - half, ends + half])


def lines_of(*lines):
    return np.ascontiguousarray(np.array(lines, dtype=float).T)


def left(lines, ends, boxes, point):
    """What the half-spaces that are not the room's faces leave to a body of 0.2 m at a point, in every period (N,)."""
    seen = OccludedRegions(from_(lines, NOTHING), NOTHING, PlanBoxes(boxes, 0.1 * len(ends)), 0.0, 0.0)
    normals, offsets = half_spaces(seen, NOTHING, ends[1:].copy(), 0.2, NOTHING, 0.1)
    return (offsets - normals @ point)[:-6].min(axis=0, initial=np.inf)


def test_where_the_way_is_blocked_what_later_periods_may_touch_counts_too():
    """A wall across the way ends it early; beside its beginning, out of reach there, a post that later boxes hold."""
    ends, boxes = along_x(0.7, [0.6, 0.7, 0.9, 1.6, 2.4, 3.2, 4.0])
    wall, post = (2.1, -1, 0, 0, 1, 0, 2, 0.02, 0.02), (0.9, 2.5, -1, 0, 0, 1, 2, 0.02, 0.02)
    at_post = np.array([0.9, 2.5, 0.0])
    assert left(lines_of(wall, post), ends, boxes, at_post)[3:].max() < -0.2


@pytest.mark.parametrize("step", [3.0, 4.0])
def test_a_fast_way_through_a_shadow_that_begins_out_of_the_first_boxes_reach(step):
    ends, boxes = along_x(step, [0.6] * 5)
    lines = lines_of((3.0 * step, 0, 0, 1, 0, 0, 5.0, 0.05, 0.05))
    assert left(lines, ends, boxes, ends[3])[2:].max() < -0.2


def far_off(rng, away, n):
    """Shadows (9, n) that begin so far from the start [m] and pass it at arm's length, or hardly."""
    along = rng.normal(size=(3, n))
    along /= np.linalg.norm(along, axis=0)
    aside = rng.normal(size=(3, n))
    aside -= along * (along * aside).sum(axis=0)
    aside *= rng.uniform(0.35, 2.0, n) / np.linalg.norm(aside, axis=0)
    return np.vstack([aside - away * along, along, np.full(n, 2.0 * away), np.full((2, n), 0.01)])


@pytest.mark.parametrize("away", [3.0, 300.0, 3000.0])
@settings(max_examples=20)
@given(seed=st.integers(0, 100_000))
def test_how_near_a_shadow_is_does_not_depend_on_how_far_off_it_begins(away, seed):
    rng = np.random.default_rng(seed)
    lines, place = far_off(rng, away, 40), rng.uniform(-0.2, 0.2, (2, 3))
    rooms_ = rooms(from_(lines, NOTHING), place, np.zeros(1, np.int64))[0]
    exact = np.full(40, np.inf)
    for at in place:
        off = at[:, None] - lines[:3]
        off -= np.clip((off * lines[3:6]).sum(axis=0), 0.0, lines[6]) * lines[3:6]
        exact = np.minimum(exact, np.linalg.norm(off, axis=0) - 0.01)
    assert np.abs(rooms_ - exact).max() < rounding(4.0 * away)


@pytest.mark.parametrize("row", range(9))
@pytest.mark.parametrize("value", [np.nan, np.inf, 1e39, 1e20, 2e4])
def test_shadows_that_single_precision_can_not_tell_leave_nothing_free(row, value):
    ends, boxes = along_x(0.1, [0.5] * 4)
    lines = lines_of((3.0, 0, 0, 1, 0, 0, 1, 0.1, 0.1), (-3.0, 0, 0, -1, 0, 0, 1, 0.1, 0.1))
    lines[row, 1] = value
    seen = OccludedRegions(from_(lines, NOTHING), NOTHING, PlanBoxes(boxes, 0.4), 0.0, 0.0)
    assert np.isneginf(half_spaces(seen, NOTHING, ends[1:].copy(), 0.2, NOTHING, 0.1)[1]).all()


@settings(max_examples=60)
@given(st.integers(0, 1_000_000))
def test_no_body_in_a_periods_boxes_touches_a_shadow_whatever_the_way(seed):
    """Ways that are blocked early, late or not, slow or fast, in boxes that grow; bodies that touch, at random."""
    rng = np.random.default_rng(seed)
    N, n, m = int(rng.integers(1, 13)), int(rng.integers(1, 60)), 4000
    ends = np.vstack([NOTHING, np.cumsum(rng.normal(size=(N, 3)) * 0.3 + [rng.choice([0.0, 0.3, 3.0]), 0, 0], axis=0)])
    half = 0.3 + np.cumsum(rng.uniform(0.0, 0.5, (N + 1, 3)), axis=0)
    boxes, ways = np.stack([ends - half, ends + half]), rng.normal(size=(n, 3))
    ways /= np.linalg.norm(ways, axis=1, keepdims=True)
    last = np.abs(ends).max() + np.linalg.norm(half[-1]) + 2.0
    near, wide = rng.uniform(0.3, last, n), rng.choice([0.0, 0.05])
    parts = (near[:, None] * ways).T, ways.T, last - near, 0.02 * near + wide, np.full(n, 0.02 * last + wide)
    lines = np.ascontiguousarray(np.vstack(parts))
    moves, keep_off = (rng.choice([0.0, 0.5]), 0.1), 0.2
    which, share, k = rng.integers(0, n, m), rng.random(m), rng.integers(0, N, m)
    about = lines[7, which] * (1 - share) + lines[8, which] * share + keep_off + moves[0] * 0.1 * (k + 2)
    off = rng.normal(size=(m, 3))
    off *= (about * rng.random(m) ** 0.2 / np.linalg.norm(off, axis=1))[:, None]
    bodies = lines[:3, which].T + (share * lines[6, which])[:, None] * ways[which] + off
    in_either = [((bodies >= boxes[0, e]) & (bodies <= boxes[1, e])).all(axis=1) for e in (k, k + 1)]
    origin = rng.normal(size=3)
    seen = OccludedRegions(from_(lines, origin), origin, PlanBoxes(boxes, 0.1 * N), *moves)
    normals, offsets = half_spaces(seen, NOTHING, ends[1:].copy(), keep_off, NOTHING, 0.1)
    slack = (offsets[:, k] - np.einsum("hmd,md->hm", normals[:, k], bodies)).min(axis=0)
    assert slack[in_either[0] | in_either[1]].max(initial=-np.inf) <= 1e-6


@pytest.mark.parametrize("period", [0, 2])
def test_a_way_that_is_no_number_frees_nothing_from_there_on(period):
    near = occluded_regions(scattered(0), room(2.0, 1.0), 0.0, NOTHING)
    nominal = np.tile(np.arange(1.0, 5.0)[:, None] * 0.7, 3)
    sound = half_spaces(near, np.zeros(3), 0.1 * nominal, 0.0, np.zeros(3), 0.2)[1]
    assert np.isfinite(sound).all()
    nominal[period:] = np.nan
    _, offsets = half_spaces(near, np.zeros(3), 0.1 * nominal, 0.0, np.zeros(3), 0.2)
    assert np.isneginf(offsets).all() if period == 0 else np.isfinite(offsets[:, :period]).all()


def test_all_that_reads_an_image_is_ready_before_the_first_one():
    """In an interpreter of its own: here others have imported it."""
    code = (
        "import sys; from brakeline.safety.perception.occluded_regions import prepare; prepare();"
        " names = ('proximity_kernels', 'shadow_kernels', 'occlusion_kernels');"
        " assert {f'brakeline.safety.perception.kernels.{name}' for name in names} <= set(sys.modules)"
    )
    subprocess.run([sys.executable, "-c", code], check=True)

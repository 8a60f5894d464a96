"""Laws of the compiled half-spaces: a capsule holds its shadow, and no body behind the half-spaces touches one."""

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
from brakeline.safety.perception.kernels.group_kernels import group_gaps
from brakeline.safety.perception.kernels.occlusion_kernels import supporting_planes
from brakeline.safety.perception.kernels.shadow_kernels import (
    FAR_RADIUS,
    LENGTH,
    NEAR_RADIUS,
    ROWS,
    TAPER,
    derive_rows,
    rounding,
)
from brakeline.safety.perception.occluded_regions import (
    OccludedRegions,
    PlanBoxes,
    _patches,
    half_spaces,
    occluded_regions,
)
from tests.messaging.test_range_image import COLUMNS, EDGE, RINGS
from tests.safety.perception_twins import AXIS, NEAR, patch_minimum
from tests.safety.test_occluded_regions import ORIGIN, room

TURN = (math.cos(0.4), 0.3 * math.sin(0.4), 0.0, math.sqrt(1.0 - 0.09) * math.sin(0.4))  # a quaternion


def scattered(seed, at=(0.2, -0.1, 0.3)):
    """Return an image of blocks at random distances, from a sensor that is turned."""
    rng = np.random.default_rng(seed)
    ranges = np.repeat(np.repeat(rng.uniform(1.0, 6.0, (RINGS // 5, COLUMNS // 5)), 5, 0), 5, 1)
    known = {"low": -EDGE, "high": EDGE, "far": 8.0, "position_error": 0.03, "angle_error": 0.01}
    return RangeImage(ranges, at, TURN, **known)


@pytest.mark.parametrize("at", [(0.2, -0.1, 0.3), (3.4, -0.1, 0.3)], ids=["inside", "outside"])
@settings(max_examples=20)
@given(seed=st.integers(0, 100_000))
def test_a_capsule_holds_all_of_its_shadow_in_the_boxes_for_any_error_within_bounds(at, seed):
    """Also from a sensor outside the boxes, as in an old image."""
    rng, image = np.random.default_rng(seed), scattered(seed, at)
    origin = np.array([0.5, 0.3, -0.2])
    capsules = occluded_regions(image, room(2.0, 1.0), 0.2, origin).capsules.astype(float)
    capsules[NEAR] += origin[:, None]
    grid, free = patch_free_ranges(image)
    columns_per_patch, middles = _patches(grid)
    middles, free = middles.T, patch_minimum(free, columns_per_patch)
    which = rng.integers(len(middles), size=4000)
    aside = rng.normal(size=(4000, 3))
    aside -= np.einsum("nd,nd->n", aside, middles[which])[:, None] * middles[which]
    aside *= math.tan(grid.half_diagonal + image.angle_error) / np.linalg.norm(aside, axis=1, keepdims=True)
    ways = middles[which] + aside
    ways /= np.linalg.norm(ways, axis=1, keepdims=True)
    off = rng.normal(size=(4000, 3))
    off *= image.position_error / np.linalg.norm(off, axis=1, keepdims=True)
    points = image.sensor() + (free[which] * rng.uniform(1.0, 3.0, 4000))[:, None] * (ways @ image.rotation.T) + off
    inside = (np.abs(points) < 2.0).all(axis=1)
    assert inside.sum() > 50
    for point, patch in zip(points[inside][:100], which[inside][:100], strict=True):
        (index,) = np.flatnonzero(capsules[AXIS].T @ (image.rotation @ middles[patch]) > 1.0 - 5e-7)
        capsule, share = capsules[:, index], np.linspace(0.0, 1.0, 400)
        centers = capsule[NEAR] + (share * capsule[LENGTH])[:, None] * capsule[AXIS]
        radii = capsule[NEAR_RADIUS] + share * (capsule[FAR_RADIUS] - capsule[NEAR_RADIUS])
        assert (np.linalg.norm(point - centers, axis=1) <= radii + 1e-3).any(), "in no ball of the hull"


@settings(max_examples=30)
@given(st.integers(0, 100_000), st.integers(1, 60), st.sampled_from([0.0, 0.05]))
def test_every_shadow_is_beyond_some_half_space_of_every_chord(seed, n, give):
    rng = np.random.default_rng(seed)
    near, axis = rng.normal(size=(3, n)), rng.normal(size=(3, n))
    near *= rng.uniform(1.5, 3.0, n) / np.linalg.norm(near, axis=0)
    axis /= np.linalg.norm(axis, axis=0)
    values = np.vstack([near, axis, rng.uniform(0.0, 3.0, n), rng.uniform(0.0, 0.1, n), rng.uniform(0.1, 0.3, n)])
    start = rng.uniform(-0.2, 0.2, 3)
    chords, gaps = rng.uniform(-0.3, 0.3, (3, 2, 3)), rng.random((3, n), np.float32)
    search = 0.2, give, 1e-4
    normals, levels = supporting_planes(capsules_of(values, start), chords, gaps, np.full(3, np.inf), n, search)
    near = near - start[:, None]
    ends = [(near, values[NEAR_RADIUS]), (near + values[LENGTH] * axis, values[FAR_RADIUS])]
    for group in range(3):
        used = levels[group] < FARTHEST
        least = [normals[group, used] @ end - radius for end, radius in ends]
        assert (np.minimum(*least) >= levels[group, used, None] - 1e-9).any(axis=0).all()
        assert np.allclose(np.linalg.norm(normals[group, used], axis=1), 1.0)


def test_if_the_half_spaces_do_not_suffice_nothing_is_free():
    one_on_either_side = np.column_stack([[side, 0, 0, side, 0, 0, 1, 0, 0] for side in (-1.0, 1.0)])
    capsules = capsules_of(one_on_either_side, ORIGIN)

    def levels(most, reach):
        chords, gaps = np.zeros((1, 2, 3)), np.ones((1, 2), np.float32)
        return supporting_planes(capsules, chords, gaps, np.full(1, reach), most, (0.0, 0.0, 1e-4))[1]

    assert np.isfinite(levels(2, np.inf)).all()
    assert np.isneginf(levels(1, np.inf)).all()
    assert levels(1, 0.9).size == 0


def capsules_of(values, origin):
    """Return capsules (ROWS, n) relative to an origin (3,), from the rows before `TAPER` in the world's frame."""
    capsules = np.empty((ROWS, values.shape[1]), np.float32)
    with np.errstate(over="ignore"):
        capsules[NEAR], capsules[3:TAPER] = values[NEAR] - origin[:, None], values[3:]
    derive_rows(capsules)
    return capsules


def along_x(step, half):
    """Return ends (N+1, 3) that are a step apart, and boxes (2, N+1, 3) around them with half-widths (N+1,)."""
    half = np.asarray(half)[:, None] * np.ones(3)
    ends = np.zeros((len(half), 3))
    ends[:, 0] = step * np.arange(len(half))
    return ends, np.stack([ends - half, ends + half])


def columns(*capsules):
    return np.ascontiguousarray(np.array(capsules, dtype=float).T)


def slack(values, ends, boxes, point):
    """Return the least slack (N,) of the half-spaces of each period, without the boxes' faces, for a 0.2 m body."""
    regions = OccludedRegions(capsules_of(values, ORIGIN), ORIGIN, PlanBoxes(boxes, 0.1 * len(ends)), 0.0, 0.0)
    normals, offsets = half_spaces(regions, ORIGIN, ends[1:].copy(), 0.2, ORIGIN, 0.1)
    return (offsets - normals @ point)[:-6].min(axis=0, initial=np.inf)


def test_behind_a_blocked_path_what_later_periods_may_touch_counts_too():
    """A wall blocks the path early. Later boxes hold a post that is out of reach of the first ones."""
    ends, boxes = along_x(0.7, [0.6, 0.7, 0.9, 1.6, 2.4, 3.2, 4.0])
    wall, post = (2.1, -1, 0, 0, 1, 0, 2, 0.02, 0.02), (0.9, 2.5, -1, 0, 0, 1, 2, 0.02, 0.02)
    at_post = np.array([0.9, 2.5, 0.0])
    assert slack(columns(wall, post), ends, boxes, at_post)[3:].max() < -0.2


@pytest.mark.parametrize("step", [3.0, 4.0])
def test_a_fast_path_enters_no_shadow_that_the_first_boxes_do_not_reach(step):
    ends, boxes = along_x(step, [0.6] * 5)
    shadow = columns((3.0 * step, 0, 0, 1, 0, 0, 5.0, 0.05, 0.05))
    assert slack(shadow, ends, boxes, ends[3])[2:].max() < -0.2


def far_off(rng, away, n):
    """Return capsules that begin `away` m from the start and pass it at 0.35 m to 2 m."""
    axis = rng.normal(size=(3, n))
    axis /= np.linalg.norm(axis, axis=0)
    aside = rng.normal(size=(3, n))
    aside -= axis * (axis * aside).sum(axis=0)
    aside *= rng.uniform(0.35, 2.0, n) / np.linalg.norm(aside, axis=0)
    return np.vstack([aside - away * axis, axis, np.full(n, 2.0 * away), np.full((2, n), 0.01)])


@pytest.mark.parametrize("away", [3.0, 300.0, 3000.0])
@settings(max_examples=20)
@given(seed=st.integers(0, 100_000))
def test_the_gap_to_a_shadow_is_exact_however_far_away_it_begins(away, seed):
    rng = np.random.default_rng(seed)
    values, positions = far_off(rng, away, 40), rng.uniform(-0.2, 0.2, (2, 3))
    gaps = group_gaps(capsules_of(values, ORIGIN), positions, np.zeros(1, np.int64))[0]
    exact = np.full(40, np.inf)
    for position in positions:
        off = position[:, None] - values[NEAR]
        off -= np.clip((off * values[AXIS]).sum(axis=0), 0.0, values[LENGTH]) * values[AXIS]
        exact = np.minimum(exact, np.linalg.norm(off, axis=0) - 0.01)
    assert np.abs(gaps - exact).max() < rounding(4.0 * away)


@pytest.mark.parametrize("row", range(TAPER))
@pytest.mark.parametrize("value", [np.nan, np.inf, 1e39, 1e20, 2e4])
def test_a_shadow_out_of_single_precisions_range_leaves_nothing_free(row, value):
    ends, boxes = along_x(0.1, [0.5] * 4)
    values = columns((3.0, 0, 0, 1, 0, 0, 1, 0.1, 0.1), (-3.0, 0, 0, -1, 0, 0, 1, 0.1, 0.1))
    values[row, 1] = value
    regions = OccludedRegions(capsules_of(values, ORIGIN), ORIGIN, PlanBoxes(boxes, 0.4), 0.0, 0.0)
    assert np.isneginf(half_spaces(regions, ORIGIN, ends[1:].copy(), 0.2, ORIGIN, 0.1)[1]).all()


@settings(max_examples=60)
@given(st.integers(0, 1_000_000))
def test_no_body_in_a_periods_boxes_touches_a_shadow_on_any_path(seed):
    """Paths that are blocked early, late or not, slow or fast; boxes that grow; random bodies that touch a shadow."""
    rng = np.random.default_rng(seed)
    N, n, m = int(rng.integers(1, 13)), int(rng.integers(1, 60)), 4000
    ends = np.vstack([ORIGIN, np.cumsum(rng.normal(size=(N, 3)) * 0.3 + [rng.choice([0.0, 0.3, 3.0]), 0, 0], axis=0)])
    half = 0.3 + np.cumsum(rng.uniform(0.0, 0.5, (N + 1, 3)), axis=0)
    boxes, ways = np.stack([ends - half, ends + half]), rng.normal(size=(n, 3))
    ways /= np.linalg.norm(ways, axis=1, keepdims=True)
    last = np.abs(ends).max() + np.linalg.norm(half[-1]) + 2.0
    near, wide = rng.uniform(0.3, last, n), rng.choice([0.0, 0.05])
    parts = (near[:, None] * ways).T, ways.T, last - near, 0.02 * near + wide, np.full(n, 0.02 * last + wide)
    values = np.ascontiguousarray(np.vstack(parts))
    moves, keep_off = (rng.choice([0.0, 0.5]), 0.1), 0.2
    which, share, k = rng.integers(0, n, m), rng.random(m), rng.integers(0, N, m)
    radius = values[NEAR_RADIUS, which] * (1 - share) + values[FAR_RADIUS, which] * share
    radius += keep_off + moves[0] * 0.1 * (k + 2)
    off = rng.normal(size=(m, 3))
    off *= (radius * rng.random(m) ** 0.2 / np.linalg.norm(off, axis=1))[:, None]
    bodies = values[NEAR, which].T + (share * values[LENGTH, which])[:, None] * ways[which] + off
    in_either = [((bodies >= boxes[0, e]) & (bodies <= boxes[1, e])).all(axis=1) for e in (k, k + 1)]
    origin = rng.normal(size=3)
    regions = OccludedRegions(capsules_of(values, origin), origin, PlanBoxes(boxes, 0.1 * N), *moves)
    normals, offsets = half_spaces(regions, ORIGIN, ends[1:].copy(), keep_off, ORIGIN, 0.1)
    slack = (offsets[:, k] - np.einsum("hmd,md->hm", normals[:, k], bodies)).min(axis=0)
    assert slack[in_either[0] | in_either[1]].max(initial=-np.inf) <= 1e-6


@pytest.mark.parametrize("value", [np.nan, np.inf])
@pytest.mark.parametrize("period", [0, 2])
def test_a_path_with_nan_is_not_free_from_there_on(period, value):
    near = occluded_regions(scattered(0), room(2.0, 1.0), 0.0, ORIGIN)
    nominal = np.tile(np.arange(1.0, 5.0)[:, None] * 0.7, 3)
    sound = half_spaces(near, np.zeros(3), 0.1 * nominal, 0.0, np.zeros(3), 0.2)[1]
    assert np.isfinite(sound).all()
    nominal[period:] = value
    _, offsets = half_spaces(near, np.zeros(3), 0.1 * nominal, 0.0, np.zeros(3), 0.2)
    assert np.isneginf(offsets).all() if period == 0 else np.isfinite(offsets[:, :period]).all()


def test_prepare_loads_every_kernel_that_reads_images():
    """In an interpreter of its own, because other tests have loaded the kernels here."""
    code = (
        "import sys; from brakeline.safety.perception.occluded_regions import prepare; prepare();"
        " names = ('proximity_kernels', 'shadow_kernels', 'group_kernels', 'occlusion_kernels');"
        " assert {f'brakeline.safety.perception.kernels.{name}' for name in names} <= set(sys.modules)"
    )
    subprocess.run([sys.executable, "-c", code], check=True)

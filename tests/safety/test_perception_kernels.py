"""The compiled kernels of perception compute what their plain NumPy twins do."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from brakeline.messaging.obstacle import FARTHEST
from brakeline.messaging.range_image import directions
from brakeline.safety.perception.image_coverage import BeamGrid
from brakeline.safety.perception.kernels import group_kernels, occlusion_kernels, proximity_kernels, shadow_kernels
from brakeline.safety.perception.kernels.shadow_kernels import AXIS_X, EXTENT, LENGTH, NEAR_RADIUS, NEAR_X, ROWS, TAPER
from tests.safety import perception_twins as twins

SEEDS = st.integers(0, 100_000)


def capsules_around(rng, n):
    """n capsules that begin 0.3 m to 6 m from the origin, in any direction."""
    capsules = np.zeros((ROWS, n), np.float32)
    near, axis = rng.normal(size=(3, n)), rng.normal(size=(3, n))
    capsules[twins.NEAR] = near / np.linalg.norm(near, axis=0) * rng.uniform(0.3, 6.0, n)
    capsules[twins.AXIS] = axis / np.linalg.norm(axis, axis=0)
    capsules[LENGTH : NEAR_RADIUS + 2] = rng.uniform(0.0, [[5.0], [0.1], [0.3]], (3, n))
    shadow_kernels.derive_rows(capsules)
    return capsules


@settings(max_examples=40)
@given(SEEDS, st.integers(2, 9), st.integers(3, 24), st.integers(0, 9), st.booleans())
def test_free_ranges_of_single_beams_come_from_returns_without_ghosts(seed, rings, columns, rows, whole):
    rng = np.random.default_rng(seed)
    ranges = rng.uniform(0.2, 9.0, (rings, columns))
    ranges[rng.random(ranges.shape) < 0.1 * (not whole)] = 0.0
    below, above = map(int, rng.integers(0, 3, 2))
    size = 0 if whole else below + above
    added, beside = ((0, 0) if whole else (below, above)), rng.integers(0, columns, rings + size)
    arguments = ranges, added, (8.0, 0.05, 0), (0.8, rows, beside), (rows, beside), (0.9, 3.0)
    returns, free = proximity_kernels.single_beam_ranges(*arguments)
    twin_returns, twin_free = twins.single_beam_ranges(*arguments)
    assert np.array_equal(returns, twin_returns) and np.array_equal(free, twin_free)


@settings(max_examples=30)
@given(SEEDS, st.integers(2, 40), st.integers(1, 30))
def test_a_patch_is_as_near_as_the_nearest_of_its_beams(seed, rings, columns):
    """Also if a patch near a pole is wider than its ring."""
    rng = np.random.default_rng(seed)
    free, width = rng.random((rings, columns), np.float32), rng.integers(1, 3 * columns, rings)
    expected = twins.patch_minimum(free, width)
    assert np.array_equal(shadow_kernels.patch_minimum(free, width, len(expected)), expected)


@pytest.mark.parametrize("sensor", [(0.2, -0.1, 0.3), (3.4, -0.1, 0.3)], ids=["inside", "outside"])
@settings(max_examples=20)
@given(seed=SEEDS)
def test_shadows_that_meet_the_boxes_become_capsules(sensor, seed):
    rng = np.random.default_rng(seed)
    grid = BeamGrid.of(20, 40, -1.4, 1.4)
    ways = np.ascontiguousarray(directions(grid.elevations, 40).reshape(-1, 3).T, np.float32)
    free = rng.uniform(0.5, 5.0, (len(grid.elevations), 40)).astype(np.float32)
    attitude = rng.normal(size=4)
    pose = tuple(attitude / np.linalg.norm(attitude)), sensor, (0.1, 0.0, 0.05)
    boxes = np.stack([rng.uniform(-2.0, -1.0, (3, 3)), rng.uniform(1.0, 2.0, (3, 3))])
    patches, origin = (np.ones(len(free), np.int64), ways), rng.normal(size=3)
    capsules = shadow_kernels.shadow_capsules(free, patches, pose, boxes, (0.2, 0.05, 0.03), origin)
    twin, depth = twins.shadow_capsules(free, patches, pose, boxes, (0.2, 0.05, 0.03), origin)
    sure = twin[:, depth > 1e-3]
    assert sure.shape[1] <= capsules.shape[1] <= (depth > -1e-3).sum(), "rounding decides only at the faces"
    by_axis = twin[twins.AXIS].T @ capsules[twins.AXIS]
    assert np.allclose(capsules[:TAPER], twin[:TAPER, by_axis.argmax(axis=0)], atol=1e-4)
    assert np.allclose(capsules[TAPER:], twin[TAPER:, by_axis.argmax(axis=0)], rtol=1e-2, atol=1e-3)


@settings(max_examples=40)
@given(SEEDS, st.integers(1, 10), st.integers(1, 100))
def test_half_spaces_of_a_path(seed, periods, n):
    rng = np.random.default_rng(seed)
    steps = rng.normal(size=(periods, 3)) * 0.2 + [rng.choice([0.0, 0.3]), 0.0, 0.0]
    capsules, origin = capsules_around(rng, n), rng.normal(size=3)
    ends = origin + np.vstack([np.zeros(3), np.cumsum(steps, axis=0)])
    half = 0.1 + np.cumsum(rng.uniform(0.0, 0.2, (periods + 1, 3)), axis=0)
    boxes, first = np.stack([ends - half, ends + half]), group_kernels.group_periods(ends, 0.6)
    reached = ends, first, int(rng.integers(1, len(first) + 1)), boxes, np.cumsum(rng.random(periods)), 0.3
    assert np.allclose(group_kernels.group_reach(*reached), twins.group_reach(*reached))
    plan, motion = (ends[0], ends[1:], boxes), (0.05, 0.02)
    arguments = capsules, origin, plan, motion, (0.1, np.full(3, 0.01)), (40, 0.05)
    normals, levels = occlusion_kernels.path_planes(*arguments)
    twin_normals, twin_levels = twins.path_planes(*arguments)
    assert np.allclose(normals, twin_normals, atol=1e-4) and np.allclose(levels, twin_levels, atol=1e-4)


@pytest.mark.parametrize("row", [NEAR_X, AXIS_X, LENGTH, NEAR_RADIUS])
def test_the_extent_of_a_capsule_with_nan_is_nan(row):
    capsules = capsules_around(np.random.default_rng(0), 4)
    capsules[row, 2] = np.nan
    shadow_kernels.derive_rows(capsules)
    assert np.isnan(capsules[EXTENT]).tolist() == [False, False, True, False]
    ends = np.zeros((2, 3))
    plan = ends[0], ends[1:], np.stack([ends - 0.1, ends + 0.1])
    levels = occlusion_kernels.path_planes(capsules, ends[0], plan, (0.0, 0.0), (0.1, ends[0]), (8, 0.0))[1]
    assert np.isneginf(levels).all() and not np.isfinite(FARTHEST * np.nan)


def test_a_kernel_refuses_other_types():
    with pytest.raises(TypeError):
        proximity_kernels.window_minimum(np.zeros((3, 3)), 1, np.ones(3, np.int64))

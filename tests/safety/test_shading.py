"""What the compiled loops over shadows say, line by line: a shadow holds its patch, and is beyond some half-space."""

import math
import subprocess
import sys

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from messaging.patches import half_diagonal, seen_free
from messaging.range_images import RangeImage
from messaging.shapes import FARTHEST
from safety.shading import supporting, told_from
from safety.shadows import _patches, half_spaces, shadows
from tests.messaging.test_range_images import COLUMNS, EDGE, RINGS
from tests.safety.test_shadows import room

TURN = (math.cos(0.4), 0.3 * math.sin(0.4), 0.0, math.sqrt(1.0 - 0.09) * math.sin(0.4))  # a quaternion


def scattered(seed):
    """An image of blocks in random distances, by a sensor that is turned."""
    rng = np.random.default_rng(seed)
    ranges = np.repeat(np.repeat(rng.uniform(1.0, 6.0, (RINGS // 5, COLUMNS // 5)), 5, 0), 5, 1)
    known = {"low": -EDGE, "high": EDGE, "far": 8.0, "position_error": 0.03, "angle_error": 0.01}
    return RangeImage(ranges, (0.2, -0.1, 0.3), TURN, **known)


@settings(max_examples=20)
@given(st.integers(0, 100_000))
def test_a_shadow_holds_all_of_its_patch_that_comes_into_the_room_whatever_the_errors(seed):
    rng, image = np.random.default_rng(seed), scattered(seed)
    lines = shadows(image, room(2.0, 1.0), 0.2).lines
    elevations, free = seen_free(image)
    together, middles = _patches(elevations.tobytes(), COLUMNS)
    middles = middles.T
    free = np.concatenate(
        [np.minimum.reduceat(ring, np.arange(0, COLUMNS, each)) for ring, each in zip(free, together, strict=True)]
    )
    which = rng.integers(len(middles), size=4000)
    aside = rng.normal(size=(4000, 3))
    aside -= np.einsum("nd,nd->n", aside, middles[which])[:, None] * middles[which]
    aside *= math.tan(half_diagonal(image) + image.angle_error) / np.linalg.norm(aside, axis=1, keepdims=True)
    ways = middles[which] + aside
    ways /= np.linalg.norm(ways, axis=1, keepdims=True)
    off = rng.normal(size=(4000, 3))
    off *= image.position_error / np.linalg.norm(off, axis=1, keepdims=True)
    points = image.sensor() + (free[which] * rng.uniform(1.0, 3.0, 4000))[:, None] * (ways @ image.turn.T) + off
    inside = (np.abs(points) < 2.0).all(axis=1)
    assert inside.sum() > 50
    for point, patch in zip(points[inside][:100], which[inside][:100], strict=True):
        (line,) = np.flatnonzero(lines[3:6].T @ (image.turn @ middles[patch]) > 1.0 - 1e-7)
        near, along, (length, about_near, about_far) = lines[:3, line], lines[3:6, line], lines[6:, line]
        share = np.linspace(0.0, 1.0, 400)
        there = near + (share * length)[:, None] * along
        about = about_near + share * (about_far - about_near)
        assert (np.linalg.norm(point - there, axis=1) <= about + 1e-3).any(), "in the hull of the balls"


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
    normals, levels = supporting(told_from(lines, start), chords, room, np.full(3, np.inf), 0.2, n, give, FARTHEST)
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
    told, everywhere = told_from(lines, np.zeros(3)), np.full(1, np.inf)
    assert np.isfinite(supporting(told, chords, room, everywhere, 0.0, 2, 0.0, FARTHEST)[1]).all()
    assert np.isneginf(supporting(told, chords, room, everywhere, 0.0, 1, 0.0, FARTHEST)[1]).all()
    assert supporting(told, chords, room, np.full(1, 0.9), 0.0, 1, 0.0, FARTHEST)[1].size == 0


@pytest.mark.parametrize("period", [0, 2])
def test_a_way_that_is_no_number_frees_nothing_from_there_on(period):
    near = shadows(scattered(0), room(2.0, 1.0), 0.0)
    nominal = np.tile(np.arange(1.0, 5.0)[:, None] * 0.7, 3)
    sound = half_spaces(near, np.zeros(3), 0.1 * nominal, 0.0, np.zeros(3), 0.2)[1]
    assert np.isfinite(sound).all()
    nominal[period:] = np.nan
    _, offsets = half_spaces(near, np.zeros(3), 0.1 * nominal, 0.0, np.zeros(3), 0.2)
    assert np.isneginf(offsets).all() if period == 0 else np.isfinite(offsets[:, :period]).all()


def test_all_that_reads_an_image_is_ready_before_the_first_one():
    """In an interpreter of its own: here others have imported it."""
    code = (
        "import sys; from safety.shadows import prepare; prepare(); assert {'messaging.nearby', 'safety.shading'}"
        " <= set(sys.modules)"
    )
    subprocess.run([sys.executable, "-c", code], check=True)

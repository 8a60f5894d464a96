"""Half-spaces: the obstacle, grown by the body and the measurement error, is beyond them."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from brakeline.messaging.obstacle import Obstacle, Shapes
from brakeline.safety.filter.halfspaces import half_spaces, half_spaces_leading_out
from tests.messaging.test_obstacle import obstacles, sample

pytestmark = pytest.mark.fast

BODY = 0.1


@given(obstacles(), st.integers(0, 10_000))
def test_a_body_on_the_near_side_keeps_off_the_obstacle(obstacle, seed):
    rng = np.random.default_rng(seed)
    d = len(obstacle.position)
    start, nominal = rng.uniform(-5, 5, d), rng.uniform(-5, 5, (3, d))
    measured = rng.uniform(0, 0.05, d)
    near = Shapes.of([obstacle], d)
    normals, offsets = half_spaces(near, start, nominal, BODY, measured)
    assert normals.shape == (1, 3, d)
    drawn = sample(obstacle, rng, 2000)
    for a, b in zip(normals[0], offsets[0], strict=True):
        if near.distance(start)[0] < 1e-6:
            assert b == -np.inf
            continue
        assert np.linalg.norm(a) == pytest.approx(1.0)
        for _ in range(5):  # a measured position on the plane: the true one, and the body about it, are clear
            p = start + rng.normal(size=d)
            p += a * (b - a @ (p - start))
            true = p - measured * rng.choice([-1.0, 1.0], d)
            assert np.linalg.norm(drawn - true, axis=1).min() >= BODY - 1e-7
            assert (a @ (drawn - true).T).min() >= BODY - 1e-7


POST = Obstacle("cylinder", (1.0, 0.0), (0.3,))


def test_the_plane_turns_with_the_nominal_position_unless_that_is_inside_the_obstacle_or_behind_it():
    near = Shapes.of([POST], 2)
    normals, offsets = half_spaces(near, np.zeros(2), np.array([[0.8, 0.4]]), 0.0, np.zeros(2))
    assert np.allclose(normals[0, 0], np.array([0.2, -0.4]) / np.hypot(0.2, 0.4))
    nominal = np.array([[0.5, 0.0], [1.0, 0.1], [2.0, 0.0]])
    normals, offsets = half_spaces(near, np.zeros(2), nominal, BODY, np.array([0.01, 0.02]))
    assert np.allclose(normals, [1.0, 0.0]), "the start determines the plane"
    assert np.allclose(offsets, 0.7 - BODY - 0.01)


@pytest.mark.parametrize("start", [(1.0, 0.0), (1.2, 0.1), (0.7, 0.0)])
def test_nothing_is_free_for_a_start_that_touches(start):
    near = Shapes.of([POST, Obstacle("wall", (-1.0, 0.0))], 2)
    _, offsets = half_spaces(near, np.array(start), np.zeros((2, 2)), BODY, np.zeros(2))
    assert (offsets[0] == -np.inf).all()
    assert np.isfinite(offsets[1]).all()


@given(obstacles(), st.integers(0, 10_000))
def test_half_spaces_that_lead_out_have_the_obstacle_behind_them_and_are_the_same_outside(obstacle, seed):
    rng = np.random.default_rng(seed)
    d = len(obstacle.position)
    near, measured, drawn = Shapes.of([obstacle], d), rng.uniform(0, 0.05, d), sample(obstacle, rng)
    for start in (drawn[0], rng.uniform(-5, 5, d)):
        nominal = start + rng.uniform(-1, 1, (3, d))
        planes = half_spaces(near, start, nominal, BODY, measured)
        normals, offsets = half_spaces_leading_out(near, start, BODY, measured, planes)
        if near.distance(start)[0] > 0.0:
            assert (normals == planes[0]).all() and (offsets == planes[1]).all()
        elif np.isfinite(offsets).all():  # except in the middle, where no way out is known
            assert (offsets < 0.0).all()  # it is not free yet
            clearance = BODY + np.abs(normals[0, 0]) @ measured
            assert ((drawn - start) @ normals[0, 0] >= offsets[0, 0] + clearance - 1e-7).all()


def test_an_obstacle_with_nan_leaves_nothing_free():
    near = Shapes.of([POST], 2)
    broken = replace(near, center=near.center * np.nan)
    _, offsets = half_spaces(broken, np.zeros(2), np.zeros((1, 2)), BODY, np.zeros(2))
    assert not (offsets > -np.inf).any()


def test_a_period_that_passes_the_obstacle_keeps_the_room_beside_it():
    """A plane for one end of the period alone would cut off the other end."""
    near = Shapes.of([Obstacle("cylinder", (1.5, 1.0), (0.5,))], 2)
    nominal = np.array([[1.0, 0.0], [2.0, 0.0], [3.0, 0.0]])
    normals, offsets = half_spaces(near, np.zeros(2), nominal, 0.0, np.zeros(2))
    assert np.allclose(normals[0, 1], [0.0, 1.0]) and offsets[0, 1] == pytest.approx(0.5)
    ends = np.vstack([np.zeros(2), nominal])
    for k in range(3):
        assert (ends[k : k + 2] @ normals[0, k] < offsets[0, k] - 0.2).all()


@given(obstacles(), st.integers(0, 10_000))
def test_no_plan_that_touches_the_obstacle_is_inside_its_half_spaces(obstacle, seed):
    rng = np.random.default_rng(seed)
    d = len(obstacle.position)
    near = Shapes.of([obstacle], d)
    nominal = np.cumsum(rng.uniform(-1.5, 1.5, (5, d)), axis=0)
    start, nominal = nominal[0], nominal[1:]
    normals, offsets = half_spaces(near, start, nominal, 0.0, np.zeros(d))
    ends = np.vstack([start, nominal])
    chords = ends[:-1, None] + np.linspace(0.0, 1.0, 200)[:, None] * np.diff(ends, axis=0)[:, None]
    touched = (near.distance(chords)[0] < 1e-9).any(axis=1)
    inside = [((ends[k : k + 2] - start) @ normals[0, k] <= offsets[0, k]).all() for k in range(len(nominal))]
    assert not (touched & np.array(inside)).any()

"""Laws of zonotopes: sampled points stay inside what is computed from the set."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from brakeline.safety.model.zonotope import Zonotope, facet_normals
from tests.safety.linear import PUBLISHED

pytestmark = pytest.mark.fast

NUMBERS = st.floats(-5, 5).map(lambda value: round(value, 3))


@st.composite
def zonotopes(draw, dim=2, most=6):
    count = draw(st.integers(1, most))
    return Zonotope(draw(arrays(float, dim, elements=NUMBERS)), draw(arrays(float, (dim, count), elements=NUMBERS)))


def points(zonotope, seed=0, count=40):
    rng = np.random.default_rng(seed)
    b = rng.uniform(-1, 1, (count, zonotope.generators.shape[1]))
    b[::2] = np.sign(b[::2])
    return zonotope.center + b @ zonotope.generators.T


def inside(zonotope, samples):
    """Judged by supports in many directions, written out here."""
    directions = np.random.default_rng(1).normal(size=(50, zonotope.dim))
    reach = directions @ zonotope.center + np.abs(directions @ zonotope.generators).sum(1)
    return (samples @ directions.T <= reach + 1e-9).all()


@given(zonotopes(), arrays(float, (3, 2), elements=NUMBERS))
def test_a_map_contains_the_mapped_points(zonotope, matrix):
    mapped = zonotope.map(matrix)
    assert inside(mapped, points(zonotope) @ matrix.T)
    direction = np.array([1.0, -2.0, 0.5])
    assert mapped.support(direction) == pytest.approx(float(zonotope.support(matrix.T @ direction)))


@given(zonotopes(), zonotopes())
def test_sums_and_products_contain_sums_and_pairs(one, other):
    assert inside(one + other, points(one, 1) + points(other, 2))
    assert inside(one.product(other), np.hstack([points(one, 1), points(other, 2)]))
    directions = np.random.default_rng(3).normal(size=(10, 2))
    assert np.allclose((one + other).support(directions), one.support(directions) + other.support(directions))


@given(zonotopes(most=9), st.floats(1.0, 3.0))
def test_reduction_contains_the_original(zonotope, order):
    reduced = zonotope.reduce(order)
    assert reduced.generators.shape[1] <= max(2, int(order * 2))
    assert inside(reduced, points(zonotope))


@settings(max_examples=20)
@given(zonotopes(most=4))
def test_membership_by_norm_agrees_with_the_samples(zonotope):
    for point in points(zonotope, count=4):
        assert zonotope.contains(point, 1e-7)
    far = zonotope.center + (zonotope.hull()[1] - zonotope.center) * 1.1 + 0.1
    assert not zonotope.contains(far)


@given(zonotopes(dim=2), st.integers(0, 100))
def test_facet_normals_decide_membership_in_the_plane(zonotope, seed):
    normals = facet_normals(zonotope.generators)
    if np.linalg.matrix_rank(zonotope.generators, tol=1e-6) < 2:
        return
    low, high = zonotope.hull()
    point = np.random.default_rng(seed).uniform(low, high)
    norm = zonotope.norm(point)
    reach = np.abs(normals @ zonotope.generators).sum(1)
    outside = np.max(np.abs(normals @ (point - zonotope.center)) / reach)
    assert outside == pytest.approx(norm, abs=1e-6)


def test_facet_normals_in_space_are_those_of_a_box_and_of_a_skew_one():
    assert sorted(map(tuple, np.abs(facet_normals(np.eye(3))))) == [(0, 0, 1), (0, 1, 0), (1, 0, 0)]
    rng = np.random.default_rng(4)
    generators = rng.normal(size=(3, 5))
    normals, body = facet_normals(generators), Zonotope(np.zeros(3), generators)
    assert len(normals) == 10
    for point in rng.normal(size=(20, 3)) * 2:
        worst = np.max(np.abs(normals @ point) / np.abs(normals @ generators).sum(1))
        assert worst == pytest.approx(body.norm(point), abs=1e-6)
    with pytest.raises(ValueError, match="up to 3"):
        facet_normals(np.eye(4))
    assert facet_normals(np.ones((1, 2))).shape == (1, 1)


def test_a_box_has_one_generator_an_axis():
    box = Zonotope.box([0.0, 0.0], [1.0, 2.0])
    corners = np.array([[1.0, 2.0], [1.0, -2.0], [-1.0, 2.0], [-1.0, -2.0]])
    assert inside(box, corners)
    line = Zonotope(np.zeros(2), np.array([[1.0], [2.0]]))  # the trap: one generator of the half-widths
    assert not inside(line, corners)


def test_shapes_that_do_not_fit_are_refused():
    with pytest.raises(ValueError, match="do not fit"):
        Zonotope(np.zeros(2), np.zeros((3, 1)))
    with pytest.raises(ValueError, match="below order 1"):
        Zonotope(np.zeros(2), np.ones((2, 5))).reduce(0.4)


def test_published_atoms():
    atoms = PUBLISHED["zonotope_atoms"]
    hull = Zonotope(*(np.array(atoms["hull_volume"][name], float) for name in "cG"))
    low, high = hull.hull()
    assert hull.volume() == pytest.approx(atoms["hull_volume"]["volume"], abs=1e-8)
    assert np.allclose(low, atoms["hull_volume"]["hull_lo"], atol=1e-8)
    assert np.allclose(high, atoms["hull_volume"]["hull_hi"], atol=1e-8)
    support = atoms["support"]
    shape = Zonotope(np.array(support["c"], float), np.array(support["G"], float))
    assert np.allclose(shape.support(np.array(support["dir"], float)), support["value"], atol=1e-8)
    norm = atoms["norm"]
    shape = Zonotope(np.zeros(2), np.array(norm["G"], float))
    assert [shape.norm(np.array(p, float)) for p in norm["points"]] == pytest.approx(norm["value"], abs=1e-8)
    assert Zonotope(np.zeros(2), np.array([[1.0], [0.0]])).norm(np.array([0.0, 1.0])) == np.inf

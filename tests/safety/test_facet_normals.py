"""The facets of a zonotope decide which points lie in it."""

from itertools import product

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial import ConvexHull

from brakeline.safety.model.facet_normals import facet_normals


@pytest.mark.parametrize("dim", [2, 3])
@given(seed=st.integers(0, 2**32 - 1))
def test_a_point_is_inside_exactly_if_no_facet_separates_it(dim: int, seed: int) -> None:
    rng = np.random.default_rng(seed)
    generators = rng.normal(size=(dim, 5))
    vertices = np.array(list(product((-1.0, 1.0), repeat=5))) @ generators.T
    hull = ConvexHull(vertices).equations  # its outward normals and offsets
    points = rng.normal(size=(50, dim)) * 3.0
    inside = (points @ hull[:, :-1].T + hull[:, -1] <= 0.0).all(1)
    normals = facet_normals(generators)
    by_support = (np.abs(points @ normals.T) <= np.abs(normals @ generators).sum(1)).all(1)
    assert (inside == by_support).all()


def test_more_than_three_dimensions_are_refused() -> None:
    with pytest.raises(ValueError, match="3 dimensions"):
        facet_normals(np.eye(4))

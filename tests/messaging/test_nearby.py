"""The least of what is nearby, compiled, beside a count that looks at every beam."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from brakeline.messaging.range_image import directions
from brakeline.safety import compilation
from brakeline.safety.perception.image_coverage import GridWindow
from brakeline.safety.perception.kernels.proximity_kernels import farthest_of_meshes, forget_ghosts, least_of


@settings(max_examples=40)
@given(st.integers(0, 100_000), st.integers(2, 9), st.integers(3, 24), st.integers(0, 9))
def test_it_is_the_least_of_the_window(seed, rings, columns, rows):
    rng = np.random.default_rng(seed)
    values, beside = rng.random((rings, columns), np.float32), rng.integers(0, columns, rings)
    found = least_of(values, rows, beside)
    for i in range(rings):
        for j in range(columns):
            across = np.arange(j - beside[i], j + beside[i] + 1) % columns
            assert found[i, j] == values[max(i - rows, 0) : i + rows + 1][:, across].min()


@settings(max_examples=40)
@given(st.integers(0, 100_000), st.integers(2, 9), st.integers(3, 24), st.integers(0, 9))
def test_who_returns_from_nearer_than_all_meshes_about_it_could_is_forgotten(seed, rings, columns, rows):
    rng = np.random.default_rng(seed)
    returns = np.where(rng.random((rings, columns)) < 0.1, -1.0, rng.uniform(1.0, 9.0, (rings, columns)))
    returns = returns.astype(np.float32)
    beside, share, error = rng.integers(0, columns, rings), 0.8, 0.1
    right = np.roll(returns, -1, axis=1)
    meshed = np.maximum(np.maximum(returns, right), 0.0)
    meshed[:-1] = np.maximum(meshed[:-1], meshed[1:])
    assert np.array_equal(farthest_of_meshes(returns), meshed)
    least = least_of(meshed, rows, beside)
    ghosts, left = (returns >= 0.0) & (returns < share * (least - error)), returns.copy()
    assert forget_ghosts(left, meshed, share, error, rows, beside) == (left >= 0.0).sum()
    assert np.array_equal(left, np.where(ghosts, np.float32(-1.0), returns))


@settings(max_examples=12)
@given(st.integers(0, 100_000), st.floats(0.02, 1.2))
def test_nothing_within_so_much_on_the_sphere_is_left_out(seed, within):
    rings, columns = 12, 24
    elevations = np.linspace(-0.5 * math.pi, 0.5 * math.pi, rings)
    values = np.random.default_rng(seed).random((rings, columns), np.float32)
    ways = directions(elevations, columns).reshape(-1, 3)
    near = ways @ ways.T >= math.cos(within) + 1e-9
    least = np.where(near, values.ravel(), np.inf).min(axis=1).reshape(rings, columns)
    window = GridWindow.of(columns, elevations, elevations[1] - elevations[0], within)
    assert (window.least(values) <= least).all()


def test_other_types_are_refused():
    with pytest.raises(TypeError):
        least_of(np.zeros((3, 3)), 1, np.ones(3, np.int64))


def test_where_nothing_can_be_kept_it_is_compiled_anew(monkeypatch):
    tried = []

    def njit(signature, **how):
        tried.append(how)
        if how.get("cache"):
            raise RuntimeError("cannot cache function: no locator available")
        return lambda function: function

    monkeypatch.setattr(compilation, "njit", njit)
    assert compilation.compiled("f8(f8)")(abs) is abs and len(tried) == 2

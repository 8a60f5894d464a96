"""The compiled loops behind arenas give what their twins in NumPy give."""

from itertools import product

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.ndimage import label

from brakeline.messaging.obstacle import BOX, CYLINDER, SPHERE, WALL, Obstacle, Shapes
from brakeline.sim.arena import room_boundary
from brakeline.sim.kernels.arena_kernels import connected, first_fitting, nearest_distances
from tests.sim.outline_twin import gaps

numbers = st.integers(0, 2**32 - 1).map(np.random.default_rng)


def draw_obstacles(rng: np.random.Generator, dim: int, count: int) -> list[Obstacle]:
    """Draw obstacles of every kind but walls."""
    sizes = {BOX: dim, CYLINDER: dim - 1, SPHERE: 1}
    drawn = []
    for kind in rng.choice([BOX, CYLINDER, SPHERE], count).tolist():
        position, size = rng.uniform(-3.0, 3.0, dim), rng.uniform(0.1, 2.0, sizes[kind])
        drawn.append(Obstacle(kind, tuple(position.tolist()), tuple(size.tolist()), yaw=float(rng.uniform(-4.0, 4.0))))
    return drawn


@given(rng=numbers, dim=st.sampled_from([2, 3]))
def test_nearest_distances_are_those_of_the_shapes(rng: np.random.Generator, dim: int) -> None:
    obstacles = draw_obstacles(rng, dim, int(rng.integers(1, 9)))
    shapes = Shapes.of([*obstacles, *room_boundary(3.5, None if dim == 2 else 3.0)], dim)
    points = rng.uniform(-5.0, 5.0, (40, dim))
    assert nearest_distances(*shapes.parts, points) == pytest.approx(shapes.distance(points).min(axis=0), abs=1e-9)


def test_without_an_obstacle_the_distance_is_infinite() -> None:
    assert (nearest_distances(*Shapes.of([], dim=2).parts, np.zeros((2, 2))) == np.inf).all()


@given(rng=numbers, dim=st.sampled_from([2, 3]), clearance=st.floats(0.05, 0.6))
def test_connected_cells_are_those_of_one_label(rng: np.random.Generator, dim: int, clearance: float) -> None:
    size, low, cell = rng.integers(3, 7, dim), rng.uniform(-3.0, -1.0, dim), 0.7
    shapes = Shapes.of(draw_obstacles(rng, dim, int(rng.integers(1, 4))), dim)
    centres = low + cell * (np.stack(np.meshgrid(*map(np.arange, size), indexing="ij"), axis=-1) + 0.5)
    regions, _ = label(shapes.distance(centres).min(axis=0) >= clearance, structure=np.ones((3,) * dim))
    neighbours = np.array([step for step in product((-1, 0, 1), repeat=dim) if any(step)])
    first, last = rng.integers(0, size, (2, dim))
    way = connected(*shapes.parts, low, cell, size, neighbours, first, last, clearance)
    assert way == (regions[tuple(first)] == regions[tuple(last)] > 0)


def test_the_distance_of_a_point_that_is_not_a_number_is_none() -> None:
    parts = Shapes.of([*room_boundary(2.0, None)], dim=2).parts
    points = np.array([[np.nan, 0.0], [0.0, np.nan], [0.0, 0.0]])
    assert nearest_distances(*parts, points) == pytest.approx([np.nan, np.nan, 2.0], nan_ok=True)


def first_that_fits(candidates: list[Obstacle], others: list[Obstacle], gap: float) -> int:
    """Call the kernel."""
    return first_fitting(*Shapes.of(candidates, 2).parts[:4], *Shapes.of(others, 2).parts[:4], gap)


@given(rng=numbers)
def test_the_first_fitting_outline_is_that_of_the_gaps(rng: np.random.Generator) -> None:
    others = [*draw_obstacles(rng, 2, int(rng.integers(0, 6))), *room_boundary(5.0, None)]
    candidates = draw_obstacles(rng, 2, 8)
    for least in rng.uniform(0.0, 1.5, 5):
        fitting = np.flatnonzero(gaps(candidates, others) >= least)
        assert first_that_fits(candidates, others, float(least)) == (fitting[0] if len(fitting) else -1)


@pytest.mark.parametrize(
    ("one", "other", "gap"),
    [
        (Obstacle(BOX, (0.0, 0.0), (2.0, 1.0)), Obstacle(CYLINDER, (2.0, 0.0), (0.5,)), 0.5),
        # a corner over an edge
        (Obstacle(BOX, (0.0, 0.0), (2.0, 1.0)), Obstacle(BOX, (0.0, 2.0), (1.0, 1.0), np.pi / 4), 1.5 - np.sqrt(0.5)),
        (Obstacle(BOX, (0.0, 0.0), (2.0, 1.0)), Obstacle(WALL, (3.0, 0.0), yaw=np.pi), 2.0),
    ],
)
def test_gaps_between_outlines_are_exact(one: Obstacle, other: Obstacle, gap: float) -> None:
    orders = [(one, other)] if other.kind == WALL else [(one, other), (other, one)]
    for first, second in orders:
        assert first_that_fits([first], [second], gap - 1e-9) == 0
        assert first_that_fits([first], [second], gap + 1e-9) == -1


def test_an_outline_does_not_fit_over_itself() -> None:
    crate = Obstacle(BOX, (0.0, 0.0), (2.0, 1.0))
    assert first_that_fits([crate], [crate], 1e-9) == -1

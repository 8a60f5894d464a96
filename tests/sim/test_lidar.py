"""The lidar against marching along its rays by distances to the shapes."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from messaging.robots import RAYS
from messaging.shapes import BOX, CYLINDER, WALL, Obstacle, Shapes
from sim.lidar import FAN, MAX_RANGE, cast


def march(shapes: Shapes, origin: np.ndarray, heading: float) -> np.ndarray:
    """Ranges by sphere tracing: go on by the distance to the nearest shape until it vanishes."""
    directions = np.stack((np.cos(heading + FAN), np.sin(heading + FAN)), axis=1)
    travelled = np.zeros(RAYS)
    for _ in range(3000):
        nearest = shapes.distance(origin + travelled[:, None] * directions).min(axis=0)
        travelled = np.minimum(travelled + nearest, 2.0 * MAX_RANGE)  # gone: far off, distances only double
        if ((nearest < 1e-7) | (travelled > MAX_RANGE)).all():
            break
    return np.minimum(travelled, MAX_RANGE)


def random_shapes(rng: np.random.Generator) -> Shapes:
    obstacles = [Obstacle(WALL, (-2.0, 0.3), yaw=float(rng.uniform(-0.5, 0.5)))]
    for _ in range(int(rng.integers(0, 8))):
        position = tuple(rng.uniform(-3.0, 3.0, 2))
        if rng.random() < 0.5:
            obstacles.append(Obstacle(CYLINDER, position, (float(rng.uniform(0.05, 0.6)),)))
        else:
            obstacles.append(Obstacle(BOX, position, tuple(rng.uniform(0.1, 1.0, 2)), float(rng.uniform(-4.0, 4.0))))
    return Shapes.of(obstacles, dim=2)


@given(st.integers(0, 2**32), st.floats(-3.1, 3.1))
def test_ranges_are_those_of_marching(seed: int, heading: float) -> None:
    rng = np.random.default_rng(seed)
    shapes = random_shapes(rng)
    origin = rng.uniform(-1.5, 1.5, 2)
    exact, marched = cast(shapes, origin, heading), march(shapes, origin, heading)
    # marching creeps past a shape that a ray grazes, and may count it as hit; the exact ray then goes on
    grazing = exact - marched > 1e-3
    assert (np.abs(exact - marched) < 1e-3)[~grazing].all()
    ends = origin + marched[:, None] * np.stack((np.cos(heading + FAN), np.sin(heading + FAN)), axis=1)
    assert (shapes.distance(ends).min(axis=0)[grazing] < 1e-6).all()
    assert grazing.sum() <= 1


def test_staged_ranges() -> None:
    shapes = Shapes.of([Obstacle(WALL, (2.0, 0.0), yaw=np.pi), Obstacle(CYLINDER, (0.0, -1.0), (0.25,))], dim=2)
    ranges = cast(shapes, np.zeros(2), 0.0)
    assert ranges[0] == pytest.approx(0.75)  # the first ray looks to the right
    assert ranges[-1] == MAX_RANGE
    assert ranges[RAYS // 2] == pytest.approx(2.0 / np.cos(FAN[RAYS // 2]))


def test_inside_a_shape_and_among_none() -> None:
    pillar = Shapes.of([Obstacle(CYLINDER, (0.0, 0.0), (0.5,))], dim=2)
    assert (cast(pillar, np.array([0.1, 0.0]), 0.3) == 0.0).all()
    crate = Shapes.of([Obstacle(BOX, (0.0, 0.0), (1.0, 1.0))], dim=2)
    assert (cast(crate, np.array([0.1, 0.0]), 0.3) == 0.0).all()
    assert (cast(Shapes.of([], dim=2), np.zeros(2), 0.0) == MAX_RANGE).all()

"""Ranges agree with the distances to the shapes along the beams."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from brakeline.messaging.obstacle import BOX, CYLINDER, SPHERE, WALL, Obstacle, rotate
from brakeline.messaging.ray_directions import LidarRays
from brakeline.sim.arena import Arena
from brakeline.sim.lidar import Lidar
from tests.arenas import staged_arena
from tests.robots import GROUND, QUADROTOR

PLANE, SPACE = GROUND.task.rays, QUADROTOR.task.rays
SAMPLES = 60  # along a beam


def agree(arena: Arena, rays: LidarRays, origin: np.ndarray, heading: float) -> None:
    """Check that each beam ends on a surface or at the full range, in free space up to there."""
    ranges = Lidar(arena, rays).cast(origin, heading)
    directions = rotate(rays.directions, heading)
    hit = ranges < rays.range
    assert (ranges <= rays.range).all()
    ends = origin + ranges[:, None] * directions
    assert arena.shapes.distance(ends[hit]).min(axis=0, initial=1.0) == pytest.approx(np.zeros(hit.sum()), abs=1e-6)
    shares = np.linspace(0.0, 1.0, SAMPLES)[:, None]
    before = origin + (shares * (ranges - 1e-6))[..., None] * directions
    assert arena.shapes.distance(before).min() > 0.0


def random_flat(rng: np.random.Generator) -> Arena:
    obstacles = [Obstacle(WALL, (-2.0, 0.3), yaw=float(rng.uniform(-0.5, 0.5)))]
    for _ in range(int(rng.integers(0, 8))):
        position = tuple(rng.uniform(-3.0, 3.0, 2))
        if rng.random() < 0.5:
            obstacles.append(Obstacle(CYLINDER, position, (float(rng.uniform(0.05, 0.6)),)))
        else:
            obstacles.append(Obstacle(BOX, position, tuple(rng.uniform(0.1, 1.0, 2)), float(rng.uniform(-4.0, 4.0))))
    return staged_arena(*obstacles)


def random_solid(rng: np.random.Generator) -> Obstacle:
    position = tuple(rng.uniform((-8.0, -8.0, 0.0), (8.0, 8.0, 8.0)))
    kind = (BOX, CYLINDER, SPHERE)[int(rng.integers(3))]
    size = tuple(rng.uniform(0.3, 2.0, {BOX: 3, CYLINDER: 2, SPHERE: 1}[kind]))
    return Obstacle(kind, position, size, float(rng.uniform(-4.0, 4.0)) if kind == BOX else 0.0)


@given(st.integers(0, 2**32), st.floats(-3.1, 3.1))
def test_in_the_plane_beams_end_at_the_first_surface(seed: int, heading: float) -> None:
    rng = np.random.default_rng(seed)
    arena = random_flat(rng)
    origin = rng.uniform(-1.5, 1.5, 2)
    if arena.shapes.distance(origin).min() > 0.0:
        agree(arena, PLANE, origin, heading)


@settings(deadline=None)
@given(st.integers(0, 2**32), st.sampled_from([0.0, 0.7]))
def test_in_space_beams_end_at_the_first_surface(seed: int, heading: float) -> None:
    rng = np.random.default_rng(seed)
    arena = staged_arena(*(random_solid(rng) for _ in range(8)), half_width=10.0, height=8.0, goal=(4.0, 4.0, 4.0))
    origin = rng.uniform((-9.0, -9.0, 0.5), (9.0, 9.0, 7.5))
    if arena.shapes.distance(origin).min() > 0.0:
        agree(arena, SPACE, origin, heading)


def test_ranges_in_the_plane_are_exact() -> None:
    arena = staged_arena(Obstacle(WALL, (2.0, 0.0), yaw=np.pi), Obstacle(CYLINDER, (0.0, -1.0), (0.25,)))
    ranges = Lidar(arena, PLANE).cast(np.zeros(2))
    assert ranges[0] == pytest.approx(0.75)  # the first ray points to the right
    assert ranges[-1] == PLANE.range
    assert ranges[9] == pytest.approx(2.0 / PLANE.directions[9, 0])


def test_ranges_in_space_are_exact() -> None:
    ball = Obstacle(SPHERE, (0.0, 6.0, 3.0), (1.5,))
    lidar = Lidar(staged_arena(ball, goal=(9.0, 9.0, 3.0), half_width=10.0, height=8.0), SPACE)
    ranges = lidar.cast(np.array([0.0, 0.0, 3.0])).reshape(36, 5)  # azimuths from ahead to the left, elevations upwards
    assert ranges[0, 2] == pytest.approx(10.0)  # the wall ahead
    assert ranges[9, 2] == pytest.approx(4.5)  # the ball to the left
    assert ranges[27, 0] == pytest.approx(6.0)  # 30° down to the floor
    assert ranges[27, 4] == pytest.approx(10.0)  # 30° up to the ceiling, 5 m above
    assert lidar.cast(np.array([0.0, -9.0, 3.0])).reshape(36, 5)[9, 2] == SPACE.range


def test_noise_is_cut_off_and_only_on_beams_that_hit() -> None:
    arena = staged_arena(goal=(9.0, 9.0, 3.0), half_width=20.0, height=30.0)
    origin = np.array([12.0, 0.0, 3.0])
    true = Lidar(arena, SPACE).cast(origin)
    noisy = Lidar(arena, SPACE, 0.02, np.random.default_rng(0)).ranges(origin)
    hit = true < SPACE.range
    assert 20 < hit.sum() < 160
    assert (noisy[~hit] == SPACE.range).all()
    error = noisy[hit] - true[hit]
    assert 0.012 < error.std() < 0.02 and np.abs(error).max() <= 0.04 + 1e-12
    assert noisy.max() <= SPACE.range
    close = Lidar(arena, SPACE, 0.02, np.random.default_rng(0)).ranges(np.array([19.99, 0.0, 3.0]))
    assert close.min() == 0.0
    assert (Lidar(arena, SPACE).ranges(origin) == true).all()

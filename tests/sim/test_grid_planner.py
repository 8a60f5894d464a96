"""The planner's grid has the distances of the shapes, and its paths go around obstacles."""

import math
from collections.abc import Callable
from itertools import product

import numpy as np
import pytest
from scipy.ndimage import label

from brakeline.messaging.obstacle import BOX, CYLINDER, SPHERE, Obstacle
from brakeline.messaging.robot import Robot
from brakeline.sim.arena import Arena
from brakeline.sim.arena_generator import draw_arena
from brakeline.sim.grid_planner import Routes
from tests.arenas import staged_arena
from tests.robots import GROUND, QUADROTOR


@pytest.mark.parametrize("robot", [GROUND, QUADROTOR], ids=lambda robot: robot.name)
def test_the_clearance_map_has_the_exact_distances(robot: Robot) -> None:
    drawn = draw_arena("default", np.random.default_rng(3), robot)
    grid = drawn.clearance_map
    some = np.random.default_rng(0).choice(len(grid.centres), 5000)
    exact = drawn.shapes.distance(grid.centres[some]).min(axis=0)
    assert grid.clearance.ravel()[some] == pytest.approx(exact, abs=1e-9)
    assert (grid.number(grid.centres[some]) == some).all()
    assert grid.at(grid.centres[some]) == pytest.approx(exact, abs=1e-9)
    assert grid.interpolate(grid.clearance, grid.centres[some]) == pytest.approx(exact, abs=1e-9)


def test_interpolation_between_cells_is_linear() -> None:
    grid = draw_arena("default", np.random.default_rng(3), QUADROTOR).clearance_map
    slope = np.array([1.0, -2.0, 3.0])
    points = np.random.default_rng(0).uniform((-19.0, -19.0, 1.0), (19.0, 19.0, 9.0), (200, 3))
    values = (grid.centres @ slope).reshape(grid.shape)
    assert grid.interpolate(values, points) == pytest.approx(points @ slope)


def flat(*obstacles: Obstacle) -> Arena:
    return staged_arena(*obstacles, start=(-1.0, 0.0, 0.0), goal=(1.0, 0.0), half_width=3.0)


def hall(*obstacles: Obstacle) -> Arena:
    return staged_arena(*obstacles, start=(-6.0, 0.0, 2.0), goal=(6.0, 0.0, 2.0), half_width=10.0, height=10.0)


def test_paths_go_around_obstacles_with_clearance() -> None:
    walled = flat(Obstacle(BOX, (0.0, 0.0), (0.2, 4.0)))
    routes = Routes(walled.clearance_map, walled.goal, GROUND.footprint, GROUND.footprint + 0.25)
    path = routes.path(np.array([-1.0, 0.0]), 100.0)
    assert np.linalg.norm(path[-1] - walled.goal) < 0.05
    assert walled.shapes.distance(path).min() > GROUND.footprint + 0.15
    assert not walled.clearance_map.connected((-1.0, 0.0), (1.0, 0.0), 0.51)
    assert walled.clearance_map.connected((-1.0, 0.0), (1.0, 0.0), 0.4)


@pytest.mark.parametrize(("robot", "name"), [(GROUND, "dense"), (QUADROTOR, "default")])
def test_connected_agrees_with_the_labels_of_scipy(robot: Robot, name: str) -> None:
    together = []
    for seed, clearance in product(range(3), (0.1, 0.2, 0.35, 0.8, 1.2, 1.6)):
        arena = draw_arena(name, np.random.default_rng(seed), robot)
        grid, start = arena.clearance_map, arena.start[: arena.dim]
        least = math.hypot(clearance, 0.5 * grid.cell * math.sqrt(grid.dim))
        regions, _ = label(grid.clearance >= least, structure=np.ones((3,) * grid.dim))
        first, last = regions.ravel()[grid.number(np.array([start, arena.goal]))]
        together.append(grid.connected(start, arena.goal, clearance))
        assert together[-1] == (first == last and first > 0)
    assert {True, False} == set(together)


def test_paths_go_over_obstacles_on_the_floor() -> None:
    barrier = hall(Obstacle(BOX, (0.0, 0.0, 2.5), (1.0, 20.0, 5.0)))
    routes = Routes(barrier.clearance_map, barrier.goal, QUADROTOR.footprint, 2.0)
    path = routes.path(np.array(barrier.start), 100.0)
    assert path[:, 2].max() > 6.0
    assert barrier.shapes.distance(path).min() > 1.0
    assert barrier.clearance_map.connected(barrier.start, barrier.goal, 1.5)
    assert not barrier.clearance_map.connected(barrier.start, barrier.goal, 2.6)  # 5 m are left above it


def test_the_cost_to_go_falls_along_the_path_and_is_its_length_in_free_space() -> None:
    free = hall()
    routes = Routes(free.clearance_map, free.goal, QUADROTOR.footprint, 2.0)
    along = np.stack((np.linspace(-6.0, 5.0, 12), np.zeros(12), np.full(12, 2.5)), axis=1)
    to_go = routes.cost_to_go(along)
    assert np.diff(to_go) == pytest.approx(np.full(11, -1.0), abs=0.2)
    path = routes.path(np.array([-6.0, 5.0, 2.5]), 100.0)
    assert (np.diff(routes.cost_to_go(path)) < 0.0).all()


@pytest.mark.parametrize(
    "solid", [lambda at: Obstacle(SPHERE, at, (2.0,)), lambda at: Obstacle(CYLINDER, at, (2.0, 10.0))]
)
def test_beside_an_obstacle_the_cost_to_go_is_that_of_the_path_around_it(
    solid: Callable[[tuple[float, float, float]], Obstacle],
) -> None:
    room = hall(solid((0.0, 0.0, 5.0)))
    routes = Routes(room.clearance_map, room.goal, QUADROTOR.footprint, 2.0)
    beside = np.random.default_rng(0).uniform((-5.0, -5.0, 1.0), (5.0, 5.0, 9.0), (4000, 3))
    clearance = room.shapes.distance(beside).min(axis=0)
    beside = beside[(clearance > QUADROTOR.footprint) & (clearance < 1.0)]
    assert len(beside) > 200
    assert routes.cost_to_go(beside).max() < 60.0  # a tenth of the cost of one cell inside

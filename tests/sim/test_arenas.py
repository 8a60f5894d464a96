"""Drawn arenas keep the numbers of their kind and have a path from start to goal. Compiled loops over arenas give what
NumPy and SciPy give, and the planner's paths go around obstacles.
"""

import math
from collections.abc import Callable
from itertools import product

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.ndimage import label

from brakeline.errors import UnknownName
from brakeline.messaging.obstacle import BOX, CYLINDER, SPHERE, WALL, Obstacle, Shapes
from brakeline.messaging.robot import Robot
from brakeline.messaging.task import RobotWithTask, arena_kind
from brakeline.sim.arena import Arena, room_boundary
from brakeline.sim.arena_generator import draw_arena, goal_sequence
from brakeline.sim.grid_planner import Routes
from brakeline.sim.kernels.arena_kernels import connected, first_fitting, nearest_distances
from tests.arenas import staged_arena
from tests.robots import GROUND, QUADROTOR, ROBOTS


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
    for seed, clearance in product(range(2), (0.1, 0.35, 0.8, 1.2, 1.6)):
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


CORNERS = np.array([(1.0, 1.0), (1.0, -1.0), (-1.0, 1.0), (-1.0, -1.0), (0.0, 0.0)])  # in half edges


def gaps(candidates: list[Obstacle], others: list[Obstacle]) -> np.ndarray:
    """Return the distance (k,) [m] from each candidate (no wall) to the nearest other; overlap: <= 0. The twin."""
    ours, theirs = Shapes.of(candidates, dim=2), Shapes.of(others, dim=2)
    between = np.minimum(from_corners(ours, theirs), from_corners(theirs, ours).T)
    return (between - ours.rho[:, None] - theirs.rho).min(axis=1)


def from_corners(shapes: Shapes, others: Shapes) -> np.ndarray:
    """Return the least distance (k, o) [m] from the corners of each outline to the rectangle of each other."""
    corners = (CORNERS * shapes.half[:, None]) @ shapes.axes.swapaxes(1, 2) + shapes.center[:, None]
    away = (corners[:, None] - others.center[:, None]) @ others.axes
    beyond = np.maximum(np.abs(away) - others.half[:, None], 0.0)
    return np.sqrt((beyond * beyond).sum(axis=-1)).min(axis=-1)


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


ALL = [(ROBOTS[robot], name) for robot in ROBOTS for name in ROBOTS[robot].task.arenas]
each_arena = pytest.mark.parametrize(("robot", "name"), ALL, ids=[f"{robot.name}-{name}" for robot, name in ALL])


def arena(name: str, seed: int, robot: RobotWithTask = GROUND) -> Arena:
    return draw_arena(name, np.random.default_rng(seed), robot)


def ends(drawn: Arena) -> np.ndarray:
    """Start and goal, (2, d)."""
    return np.array([drawn.start[: drawn.dim], drawn.goal])


@each_arena
def test_a_drawn_arena_keeps_the_numbers_of_its_kind(robot: RobotWithTask, name: str) -> None:
    kind = arena_kind(robot, name)
    smallest_gaps = []
    for seed in range(25):
        drawn = arena(name, seed, robot)
        placed = drawn.obstacles[: -4 if kind.height is None else -6]
        for shape, (few, many) in ((BOX, kind.boxes), (CYLINDER, kind.cylinders), (SPHERE, kind.spheres)):
            assert few <= sum(obstacle.kind == shape for obstacle in placed) <= many
        assert [o.kind for o in drawn.obstacles[len(placed) :]] == [WALL] * 4 + [BOX] * (len(drawn.bounds) - 2) * 2
        start, goal = ends(drawn)
        assert np.linalg.norm(goal - start) >= kind.goal_distance
        assert drawn.shapes.distance(ends(drawn)).min() >= robot.footprint + kind.start_clearance
        assert drawn.clearance_map.connected(start, goal, robot.footprint + kind.path_clearance)
        low, high = np.array(drawn.bounds).T
        assert (ends(drawn) > low).all() and (ends(drawn) < high).all()
        plans = [plan(obstacle) for obstacle in placed]
        walls = [plan(obstacle) for obstacle in drawn.obstacles if obstacle.kind == WALL]
        for i, obstacle in enumerate(plans):
            smallest_gaps.append(float(gaps([obstacle], [*plans[:i], *plans[i + 1 :], *walls])[0]))
    assert min(smallest_gaps) >= 2.0 * robot.footprint + kind.gap
    if name == "dense":
        assert min(smallest_gaps) < 2.0 * robot.footprint + 1.1 * kind.gap  # some gap is as narrow as allowed


def plan(obstacle: Obstacle) -> Obstacle:
    """Return the obstacle seen from above."""
    size = obstacle.size[:2] if obstacle.kind == BOX else obstacle.size[:1]
    return Obstacle(obstacle.kind, obstacle.position[:2], size, obstacle.yaw)


def test_obstacles_in_space_stand_hang_and_float_between_floor_and_ceiling() -> None:
    hanging = 0
    for seed in range(10):
        drawn = arena("default", seed, QUADROTOR)
        for obstacle in drawn.obstacles[:-6]:
            z, half = obstacle.position[2], obstacle.size[0] if obstacle.kind == SPHERE else 0.5 * obstacle.size[-1]
            if obstacle.kind == CYLINDER:
                assert (z, half) == (5.0, 5.0)
            elif obstacle.kind == BOX:
                hanging += z + half == pytest.approx(10.0)
                assert z + half == pytest.approx(10.0) or z == half
            else:
                assert half <= z <= 10.0 - half
        for z in (0.0, 10.0):  # floor and ceiling are surfaces like the walls
            assert drawn.shapes.distance(np.array([19.9, -19.9, abs(z - 0.03)]))[-2:].min() == pytest.approx(0.03)
    assert 10 < hanging < 40


@pytest.mark.parametrize("robot", [GROUND, QUADROTOR.in_real_time()], ids=lambda robot: robot.name)
def test_a_goal_sequence_leads_from_goal_to_goal(robot: RobotWithTask) -> None:
    drawn, kind = draw_arena("default", np.random.default_rng(5), robot), arena_kind(robot, "default")
    start = drawn.start[: drawn.dim]
    for stage in goal_sequence(drawn, 6, np.random.default_rng(6), robot):
        assert stage.start == start and stage.obstacles == drawn.obstacles
        assert np.linalg.norm(np.subtract(stage.goal, start)) >= kind.goal_distance
        assert stage.shapes.distance(np.array(stage.goal)).min() >= robot.footprint + kind.start_clearance
        assert stage.clearance_map is drawn.clearance_map
        assert stage.clearance_map.connected(start, stage.goal, robot.footprint + kind.path_clearance)
        start = stage.goal


def test_the_generator_determines_the_arena() -> None:
    for robot in (GROUND, QUADROTOR):
        assert arena("dense", 7, robot) == arena("dense", 7, robot)
        assert arena("dense", 7, robot) != arena("dense", 8, robot)


def test_an_unknown_arena_is_refused_with_the_names_that_exist() -> None:
    with pytest.raises(
        UnknownName,
        match="no arena is called 'moon'; there are: crossing, default, dense, few-walkers, many-walkers, open, walk",
    ):
        arena("moon", 0)
    with pytest.raises(UnknownName, match="default, dense, tall"):
        arena("open", 0, QUADROTOR)

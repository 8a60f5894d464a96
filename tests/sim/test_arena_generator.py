"""Drawn arenas keep the numbers of their kind and have a path from start to goal."""

import math
from heapq import heappop, heappush
from itertools import pairwise, product

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from brakeline.errors import UnknownName
from brakeline.messaging.obstacle import BOX, CYLINDER, SPHERE, WALL, Obstacle
from brakeline.messaging.robot import Robot
from brakeline.sim.arena import Arena
from brakeline.sim.arena_generator import arena_kind, draw_arena
from tests.robots import GROUND, QUADROTOR, ROBOTS
from tests.sim.outline_twin import gaps

ALL = [(ROBOTS[robot], name) for robot in ROBOTS for name in ROBOTS[robot].task.arenas]
each_arena = pytest.mark.parametrize(("robot", "name"), ALL, ids=[f"{robot.name}-{name}" for robot, name in ALL])


def pillar(x: float, y: float, radius: float) -> Obstacle:
    return Obstacle(CYLINDER, (x, y), (radius,))


def arena(name: str, seed: int, robot: Robot = GROUND) -> Arena:
    return draw_arena(name, np.random.default_rng(seed), robot)


def ends(drawn: Arena) -> np.ndarray:
    """Start and goal, (2, d)."""
    return np.array([drawn.start[: drawn.dim], drawn.goal])


def find_path(drawn: Arena, clearance: float) -> np.ndarray | None:
    """Return the cell centres of a path from start to goal over cells with a clearance, by greedy best-first search."""
    grid = drawn.clearance_map
    start, goal = (tuple(cell) for cell in grid.index(ends(drawn)).tolist())
    before = {start: start}
    queue = [(math.dist(start, goal), start)]
    while queue and goal not in before:
        _, here = heappop(queue)
        for step in product((-1, 0, 1), repeat=drawn.dim):
            cell = tuple(a + b for a, b in zip(here, step, strict=True))
            inside = all(0 <= c < n for c, n in zip(cell, grid.shape, strict=True))
            if inside and cell not in before and grid.clearance[cell] >= clearance:
                before[cell] = here
                heappush(queue, (math.dist(cell, goal), cell))
    if goal not in before:
        return None
    cells = [goal]
    while cells[-1] != start:
        cells.append(before[cells[-1]])
    return grid.centres[np.ravel_multi_index(np.array(cells).T, grid.shape)]


@each_arena
@settings(max_examples=6, deadline=None)
@given(seed=st.integers(0, 2**32))
def test_every_drawn_arena_has_a_path_with_its_clearance(robot: Robot, name: str, seed: int) -> None:
    drawn = arena(name, seed, robot)
    needed = robot.footprint + arena_kind(robot, name).path_clearance
    half_step = 0.5 * drawn.clearance_map.cell * np.sqrt(drawn.dim)
    way = find_path(drawn, float(np.hypot(needed, half_step)))
    assert way is not None
    way = np.concatenate(([drawn.goal], way, [drawn.start[: drawn.dim]]))
    fine = np.concatenate([np.linspace(a, b, 12) for a, b in pairwise(way)])
    # from start and goal to the centres of their cells the clearance falls by at most that distance
    assert drawn.shapes.distance(fine[12:-12]).min() >= needed - 1e-9
    assert drawn.shapes.distance(fine).min() >= needed - half_step


@each_arena
def test_a_drawn_arena_keeps_the_numbers_of_its_kind(robot: Robot, name: str) -> None:
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


def test_the_default_arenas_have_their_documented_numbers() -> None:
    counts = [len(arena("default", seed).obstacles) - 4 for seed in range(40)]
    assert (min(counts), max(counts)) == (6, 10)
    kind = arena_kind(GROUND, "default")
    assert (kind.half_width, kind.goal_distance, kind.goal_radius, kind.step_limit) == (2.5, 1.5, 0.25, 300)
    assert kind.path_clearance == 0.05
    kind = arena_kind(QUADROTOR, "default")
    assert arena("default", 0, QUADROTOR).bounds == ((-20.0, 20.0), (-20.0, 20.0), (0.0, 10.0))
    assert (kind.goal_distance, kind.goal_radius, kind.step_limit) == (12.0, 1.0, 200)
    assert arena("tall", 0, QUADROTOR).bounds[2] == (0.0, 30.0)


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

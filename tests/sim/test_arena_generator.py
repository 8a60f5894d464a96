"""Drawn arenas keep the numbers of their kind and have a path from start to goal."""

import numpy as np
import pytest

from brakeline.errors import UnknownName
from brakeline.messaging.obstacle import BOX, CYLINDER, SPHERE, WALL, Obstacle
from brakeline.messaging.task import RobotWithTask
from brakeline.sim.arena import Arena
from brakeline.sim.arena_generator import arena_kind, draw_arena, goal_sequence
from tests.robots import GROUND, QUADROTOR, ROBOTS
from tests.sim.outline_twin import gaps

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

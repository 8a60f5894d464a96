"""Arenas: what is drawn keeps its promises, a way through above all."""

from collections import deque
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from messaging.robots import GROUND
from messaging.shapes import BOX, CYLINDER, WALL, Obstacle
from sim.planner import ClearanceMap, Routes
from sim.world import ARENAS, Arena, UnknownArena, draw_arena, gaps
from sim.world import staged_arena as room


def pillar(x: float, y: float, radius: float) -> Obstacle:
    return Obstacle(CYLINDER, (x, y), (radius,))


def arena(name: str, seed: int) -> Arena:
    return draw_arena(name, np.random.default_rng(seed), GROUND)


def way_through(arena: Arena, clearance: float) -> np.ndarray | None:
    """Cell centres of some way from start to goal over cells with that clearance, by breadth-first search."""
    grid = ClearanceMap(arena.obstacles, arena.bounds)
    start, goal = (tuple(grid.index(np.array(point))) for point in (arena.start[:2], arena.goal))
    before = {start: start}
    queue = deque([start])
    while queue and goal not in before:
        x, y = queue.popleft()
        for cell in ((x + i, y + j) for i in (-1, 0, 1) for j in (-1, 0, 1)):
            inside = all(0 <= c < grid.side for c in cell)
            if inside and cell not in before and grid.clearance[cell] >= clearance:
                before[cell] = (x, y)
                queue.append(cell)
    if goal not in before:
        return None
    cells = [goal]
    while cells[-1] != start:
        cells.append(before[cells[-1]])
    return np.array([grid.centres[x * grid.side + y] for x, y in cells])


@pytest.mark.parametrize("name", ARENAS)
@settings(max_examples=12)
@given(seed=st.integers(0, 2**32))
def test_a_way_exists_at_every_point_of_it(name: str, seed: int) -> None:
    drawn = arena(name, seed)
    needed = GROUND.footprint + ARENAS[name].path_clearance
    cell = drawn.clearance_map.cell
    way = way_through(drawn, float(np.hypot(needed, cell / np.sqrt(2.0))))
    assert way is not None
    way = np.concatenate(([drawn.goal], way, [drawn.start[:2]]))
    fine = np.concatenate([np.linspace(a, b, 12) for a, b in pairwise(way)])
    assert drawn.shapes.distance(fine).min() >= needed - 1e-9


@pytest.mark.parametrize("name", ARENAS)
def test_what_is_drawn_is_within_the_kind(name: str) -> None:
    kind = ARENAS[name]
    smallest_gaps = []
    for seed in range(25):
        drawn = arena(name, seed)
        count = {shape: sum(o.kind == shape for o in drawn.obstacles) for shape in (BOX, CYLINDER, WALL)}
        assert kind.boxes[0] <= count[BOX] <= kind.boxes[1]
        assert kind.cylinders[0] <= count[CYLINDER] <= kind.cylinders[1]
        assert count[WALL] == 4
        start, goal = np.array(drawn.start[:2]), np.array(drawn.goal)
        assert np.linalg.norm(goal - start) >= kind.goal_distance
        ends = np.stack((start, goal))
        assert drawn.shapes.distance(ends).min() >= GROUND.footprint + 0.1
        assert np.abs(ends).max() < kind.half_width
        for i, obstacle in enumerate(drawn.obstacles[:-4]):
            others = drawn.obstacles[:i] + drawn.obstacles[i + 1 :]
            smallest_gaps.append(float(gaps([obstacle], others)[0]))
    assert min(smallest_gaps) >= 2.0 * GROUND.footprint + kind.gap
    if name == "dense":
        assert min(smallest_gaps) < 2.0 * GROUND.footprint + 0.11  # it gets as narrow as it may


def test_default_is_what_it_is_called_for() -> None:
    counts = [len(arena("default", seed).obstacles) - 4 for seed in range(40)]
    assert (min(counts), max(counts)) == (6, 10)
    kind = ARENAS["default"]
    assert (kind.half_width, kind.goal_distance, kind.goal_radius, kind.step_limit) == (2.5, 1.5, 0.25, 300)
    assert kind.path_clearance == 0.05


def test_the_generator_decides() -> None:
    assert arena("dense", 7) == arena("dense", 7)
    assert arena("dense", 7) != arena("dense", 8)


def test_an_unknown_name_is_refused_with_the_names_there_are() -> None:
    with pytest.raises(UnknownArena, match="default, dense, open"):
        arena("moon", 0)


def test_gaps_of_staged_shapes() -> None:
    crate = Obstacle(BOX, (0.0, 0.0), (2.0, 1.0))
    assert gaps([crate], [pillar(2.0, 0.0, 0.5)])[0] == pytest.approx(0.5)
    assert gaps([pillar(2.0, 0.0, 0.5)], [crate])[0] == pytest.approx(0.5)
    turned = Obstacle(BOX, (0.0, 2.0), (1.0, 1.0), yaw=np.pi / 4)
    assert gaps([crate], [turned])[0] == pytest.approx(1.5 - np.sqrt(0.5))  # a corner over an edge
    assert gaps([turned], [crate])[0] == pytest.approx(1.5 - np.sqrt(0.5))
    assert gaps([crate], [crate])[0] <= 0.0
    assert gaps([crate], [Obstacle(WALL, (3.0, 0.0), yaw=np.pi)])[0] == pytest.approx(2.0)


def test_the_map_holds_the_distances_to_the_shapes() -> None:
    drawn = arena("default", 3)
    exact = drawn.shapes.distance(drawn.clearance_map.centres).min(axis=0)
    assert drawn.clearance_map.clearance.ravel() == pytest.approx(exact, abs=1e-12)


def test_routes_go_round_and_keep_away() -> None:
    walled = room(Obstacle(BOX, (0.0, 0.0), (0.2, 4.0)), start=(-1.0, 0.0, 0.0), goal=(1.0, 0.0), half_width=3.0)
    routes = Routes(walled.clearance_map, walled.goal, GROUND.footprint, GROUND.footprint + 0.25)
    way = routes.way(np.array([-1.0, 0.0]), 100.0)
    assert np.linalg.norm(way[-1] - walled.goal) < 0.05
    assert walled.shapes.distance(way).min() > GROUND.footprint + 0.15
    assert not walled.clearance_map.connected((-1.0, 0.0), (1.0, 0.0), 0.51)
    assert walled.clearance_map.connected((-1.0, 0.0), (1.0, 0.0), 0.4)

"""In random scenes with pose errors, the cells of the grid that count as free are free."""

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from brakeline.messaging.obstacle import Shapes
from brakeline.safety.perception.grid_memory import KEPT, GridMemory
from tests.safety.test_scan_free_space import scene
from tests.safety.test_visibility_memory import BEHIND, taken

BODY = 0.1


def free_middles(memory):
    """Return the middles (n, 2) [m] of the cells that count as free."""
    return memory._middles()[memory._way - memory._shown_at <= KEPT * BODY]


@settings(max_examples=8, deadline=None)
@given(st.integers(0, 100_000))
def test_cells_that_count_as_free_are_free(seed):
    """The robot drives to and fro, and turns; each measured pose is wrong by all that is allowed."""
    rng = np.random.default_rng(seed)
    obstacles = scene(rng, 8)
    shapes = Shapes.of(obstacles, 2)
    start = float(shapes.distance(np.zeros(2)).min())
    memory, pose = GridMemory(BODY, start), np.array([0.0, 0.0, rng.uniform(-3, 3)])
    for _ in range(15):
        memory.fill(taken(obstacles, pose, rng), 0.2)
        free = free_middles(memory)
        assert shapes.distance(free).min() >= 0.5 * memory._cell
        ahead = pose + rng.choice([-0.05, 0.05]) * np.array([math.cos(pose[2]), math.sin(pose[2]), 0.0])
        if shapes.distance(ahead[:2]).min() > BODY:
            pose = ahead
        pose[2] += rng.uniform(-0.4, 0.4)
    assert len(free) > 300


def empty(x=0.0, heading=0.0, speed=0.0):
    """Return a scan of empty space, blind behind, without errors."""
    return taken([], (x, 0.0, heading), np.random.default_rng(0), error=1e-9, turn=0.0, speed=speed)


def behind(memory, scan):
    """Return how far [m] the memory knows the space behind the robot to be free."""
    return float((memory.fill(scan, 0.2).ranges[BEHIND] - scan.range_error).min())


def test_a_robot_that_turns_to_and_fro_remembers_what_is_behind_it():
    """The last dozen scans forget it."""
    memory = GridMemory(BODY, 0.3)
    for k in range(60):
        memory.fill(empty(0.01 * k), 0.2)
    for k in range(60):
        known = behind(memory, empty(0.6, 0.4 * math.sin(0.5 * k)))
    assert known > 0.5  # of 0.64 m, the reach


def test_jitter_of_the_poses_is_no_way_and_after_a_long_one_cells_are_forgotten():
    memory, rng = GridMemory(BODY, 0.3), np.random.default_rng(1)
    for _ in range(300):
        known = behind(memory, taken([], (0.0, 0.0, 0.0), rng))
    assert known > 0.15
    for k in range(100):  # within the cells that are known, but without a look behind
        known = behind(memory, empty(0.0, 0.3 * (-1) ** k))
    assert known <= BODY, "nothing but the body's own place"


@pytest.mark.parametrize("forget", ["reset", "speed"])
def test_nothing_that_was_stated_counts_after_a_reset_or_where_things_move(forget):
    memory = GridMemory(BODY, 0.3)
    if forget == "reset":
        memory.fill(empty(), 0.2)
        memory.reset()
    assert behind(memory, empty(speed=1.2 if forget == "speed" else 0.0)) <= BODY


def test_a_hit_in_a_free_cell_counts_also_when_the_robot_has_turned_away_from_it():
    memory = GridMemory(BODY, 0.3)
    for k in range(30):
        memory.fill(empty(0.02 * k), 0.2)
    assert behind(memory, empty(0.6, math.pi)) > 0.5
    scan = empty(0.6)
    ranges = scan.ranges.copy()
    ranges[np.abs(scan.angles) < 0.15] = 0.3
    memory.fill(replace(scan, ranges=ranges), 0.2)
    turned = memory.fill(empty(0.6, math.pi), 0.2)
    back = np.abs(np.abs(turned.angles) - math.pi) < 0.1
    assert (turned.ranges[back] - turned.range_error).max() < 0.3

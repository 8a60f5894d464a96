"""Free space from scans of random scenes contains no point of an obstacle."""

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from brakeline.errors import BadScan
from brakeline.messaging.obstacle import Obstacle, Shapes, rotate
from brakeline.messaging.scan import BeamTracks, Scan
from brakeline.safety.perception.scan_free_space import gaps, half_spaces, occupied_cells
from tests.messaging.test_obstacle import sample
from tests.safety import ray_casting

FAR, WIDTH = 3.5, 0.1
FAN = np.linspace(-math.pi, math.pi, 360, endpoint=False)


def cast(obstacles, at, angles, far=FAR):
    """Return the ranges in the plane along angles [rad]."""
    return ray_casting.cast(obstacles, at, np.stack([np.cos(angles), np.sin(angles)], axis=1), far)


def scene(rng, count=6):
    """Boxes with edges of `WIDTH` or more and discs of √½ of it or more in radius, none of them at the sensor."""
    distances = []
    while len(distances) < count:
        at = tuple(rng.uniform(-1.5, 1.5, 2))
        if rng.random() < 0.5:
            candidate = Obstacle("box", at, tuple(rng.uniform(WIDTH, 0.5, 2)), rng.uniform(-3, 3))
        else:
            candidate = Obstacle("cylinder", at, (rng.uniform(WIDTH / math.sqrt(2), 0.3),))
        if Shapes.of([candidate], 2).distance(np.zeros(2))[0] > 0.12:
            distances.append(candidate)
    return distances


def taken(rng, obstacles, drop=0.0, noise=0.0, **more):
    """A scan of these from the origin, by a sensor at the robot's middle; some beams say nothing."""
    ranges = cast(obstacles, np.zeros(2), FAN)
    ranges = np.where(ranges < FAR, np.clip(ranges + rng.uniform(-noise, noise, len(ranges)), 1e-3, FAR), FAR)
    ranges[rng.random(len(ranges)) < drop] = 0.0
    return Scan(ranges, FAN, (0.0, 0.0, 0.0), far=FAR, range_error=noise, least_width=WIDTH, **more)


@settings(max_examples=60, deadline=None)
@given(st.integers(0, 100_000), st.sampled_from([0.0, 0.1, 0.5]), st.sampled_from([0.0, 0.02]))
def test_no_obstacle_lies_in_a_free_gap(seed, drop, noise):
    rng = np.random.default_rng(seed)
    obstacles = scene(rng)
    angles, _, free = gaps(taken(rng, obstacles, drop, noise))
    solid = np.concatenate([sample(o, rng, 3000) for o in obstacles])
    range_, angle = np.linalg.norm(solid, axis=1), np.arctan2(solid[:, 1], solid[:, 0])
    gap = (np.searchsorted(angles, angle, side="right") - 1) % len(angles)
    assert (range_ >= free[gap] - 1e-9).all()


@settings(max_examples=40, deadline=None)
@given(st.integers(0, 100_000), st.sampled_from([0.0, 0.2]))
def test_every_point_of_an_obstacle_is_beyond_some_half_space(seed, drop):
    """For any pose, with the largest pose errors."""
    rng = np.random.default_rng(seed)
    obstacles = scene(rng)
    scan = taken(rng, obstacles, drop, 0.01, position_error=0.02, heading_error=0.02)
    measured = np.array([*rng.uniform(-5, 5, 2), rng.uniform(-3, 3)])
    start, error = measured[:2], rng.normal(size=2)
    turn = measured[2] + rng.uniform(-0.02, 0.02)  # of the robot's frame in the world, truly
    near = occupied_cells(replace(scan, pose=tuple(measured)), 1.0)
    nominal = start + np.cumsum(rng.uniform(-0.1, 0.1, (3, 2)), axis=0)
    normals, offsets = half_spaces(near, start, nominal, 0.0, np.zeros(2), 0.2)
    solid = np.concatenate([sample(o, rng, 1500) for o in obstacles])
    solid = solid[np.linalg.norm(solid, axis=1) < 1.0]
    world = rotate(solid, turn) + start + 0.02 * error / np.linalg.norm(error)
    for k in range(3):
        beyond = (world - start) @ normals[:, k].T >= offsets[:, k] - 1e-9
        assert beyond.any(axis=1).all()


WALL = [Obstacle("wall", (0.5, 0.0), yaw=math.pi)]


def test_a_wall_becomes_a_few_cells_and_leaves_the_space_before_it_free():
    near = occupied_cells(taken(np.random.default_rng(0), WALL), 1.0)
    assert 5 <= len(near) <= 14
    normals, offsets = half_spaces(near, np.zeros(2), np.array([[0.1, 0.0]] * 3), 0.0, np.zeros(2), 0.2)
    assert offsets.max(axis=1).min() > 0.48
    assert ((normals[:, 0] @ [0.3, 0.3]) < offsets[:, 0]).all()


def test_unknown_space_is_not_free_except_behind_lone_beams():
    blind = Scan(np.zeros(360), FAN, (0.0, 0.0, 0.0))
    assert (gaps(blind)[2] == 0.0).all() and len(occupied_cells(blind, 1.0)) > 0
    none = Scan(np.zeros(0), np.zeros(0), (0.0, 0.0, 0.0))
    ahead = np.where(np.abs(FAN) < math.pi / 6, 0.0, FAR)
    for scan in (blind, none, Scan(ahead, FAN, (0.0, 0.0, 0.0))):
        _, offsets = half_spaces(occupied_cells(scan, 1.0), np.zeros(2), np.array([[0.05, 0.0]]), 0.1, np.zeros(2), 0.2)
        assert offsets.min() < 0.0
    dropped = np.full(360, FAR)
    dropped[[10, 100]] = 0.0
    assert gaps(Scan(dropped, FAN, (0.0, 0.0, 0.0)))[2].min() > 1.8, "lone beams cost no free space nearby"


def test_with_doubt_a_lone_false_range_frees_nothing():
    scan = taken(np.random.default_rng(0), WALL)
    for first in (178, 179, 180):
        broken = scan.ranges.copy()
        broken[first : first + 3] = FAR
        free = gaps(Scan(broken, FAN, (0.0, 0.0, 0.0), doubt=1))[2]
        assert free[170:190].max() < 0.55
        assert gaps(Scan(broken, FAN, (0.0, 0.0, 0.0)))[2][170:190].max() > 2.0


@pytest.mark.parametrize("beams", [90, 180, 360])
def test_with_doubt_one_false_range_hides_no_obstacle_of_the_least_width(beams):
    """A box's corner between two beams, of which one sees through it: the edge must reach the next."""
    rng, fan = np.random.default_rng(beams), np.linspace(-math.pi, math.pi, beams, endpoint=False)
    grid = (np.stack(np.meshgrid(*[np.linspace(-0.5, 0.5, 25)] * 2), axis=-1).reshape(-1, 2)) * WIDTH
    looked = 0
    for _ in range(80):
        away, turn, yaw = rng.uniform(0.3, 2.5), rng.uniform(-0.2, 0.2), rng.uniform(-3.0, 3.0)
        at = away * np.array([math.cos(turn), math.sin(turn)])
        ranges = cast([Obstacle("box", tuple(at), (WIDTH, WIDTH), yaw)], np.zeros(2), fan)
        solid = rotate(grid, yaw) + at
        towards, far = np.arctan2(solid[:, 1], solid[:, 0]), np.linalg.norm(solid, axis=1)
        for k in np.flatnonzero(ranges < FAR):
            broken = ranges.copy()
            broken[k] = FAR
            scan = Scan(broken, fan, (0.0, 0.0, 0.0), range_error=0.0, least_width=WIDTH, doubt=1)
            angles, _, free = gaps(scan)
            gap = (np.searchsorted(angles, towards, side="right") - 1) % len(angles)
            assert (free[gap] <= far + 1e-6).all()
            looked += 1
    assert looked > 50


def test_a_lone_return_is_a_ghost_and_an_obstacle_of_the_least_width_is_not():
    ranges = np.full(360, FAR)
    ranges[[50, 100, 102]] = 0.4
    assert gaps(Scan(ranges, FAN, (0.0, 0.0, 0.0)))[2].min() > 1.0
    for turn in np.linspace(0.0, 0.02, 7):  # wherever the beams fall on it
        post = [Obstacle("box", (0.6 * math.cos(turn), 0.6 * math.sin(turn)), (WIDTH, WIDTH), turn + math.pi / 4)]
        assert gaps(taken(np.random.default_rng(0), post))[2][178:182].max() < 0.6


def test_cells_that_may_move_grow_with_time():
    still, moving = (occupied_cells(taken(np.random.default_rng(0), WALL, speed=s, age=0.1), 1.0) for s in (0.0, 1.6))
    at = (np.zeros(2), np.zeros((3, 2)), 0.0, np.zeros(2), 0.2)
    lost = half_spaces(still, *at)[1] - half_spaces(moving, *at)[1]
    assert np.allclose(lost, 1.6 * (0.1 + 0.2 * np.arange(1, 4)))


WRONG_BOUNDS = [0.0, 0.0, -0.1, 1.0], [np.nan, 0.0, 0.1, 1.0], [-1e300, 0.0, 0.1, 1.0]


@pytest.mark.parametrize(
    "wrong",
    [
        {"ranges": np.ones(3)},
        {"ranges": np.full(360, -1.0)},
        {"ranges": np.full(360, np.inf)},
        {"angles": FAN[::-1]},
        {"angles": np.linspace(0, 7, 360)},
        {"pose": (0.0, 0.0, math.nan)},
        {"least_width": 0.0},
        {"least_width": 100.0},  # mm: a sector of 30° without beams was free
        {"speed": -1.0},
        {"age": math.inf},
        {"doubt": 1.5},
        {"ranges": np.full(360, 1200, np.uint16)},
        {"tracks": BeamTracks(np.zeros(3, np.uint8), np.zeros((0, 4)))},
        {"tracks": BeamTracks(np.ones(360, np.uint8), np.zeros((0, 4)))},
        {"tracks": BeamTracks(np.zeros(360, np.int64), np.zeros((0, 4)))},
        {"tracks": BeamTracks(np.ones(360, np.uint8), np.zeros((1, 3)))},
        *({"tracks": BeamTracks(np.ones(360, np.uint8), np.array([bounds]))} for bounds in WRONG_BOUNDS),
    ],
)
def test_a_malformed_scan_is_refused(wrong):
    right = {"ranges": np.ones(360), "angles": FAN, "pose": (0.0, 0.0, 0.0)}
    Scan(**right)
    with pytest.raises(BadScan):
        Scan(**right | wrong)


def test_angles_in_degrees_are_refused_as_such():
    with pytest.raises(BadScan, match=r"reach from 0 to 359: give them in rad"):
        Scan(ranges=np.ones(360), angles=np.arange(360.0), pose=(0.0, 0.0, 0.0))

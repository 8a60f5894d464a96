"""Laws of what is made of a scan: nothing that a beam may have seen is outside of the obstacles."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from brakeline.actors.ros2.laser_obstacles import BadScan, HitErrors, _joined, obstacles, read
from brakeline.actors.ros2.sensor_frames import PlanarPose
from brakeline.messaging.obstacle import Shapes
from brakeline.messaging.ray_directions import LidarRays
from brakeline.messaging.ros2.cdr_messages import LaserScan, header
from brakeline.sim.arena_generator import draw_arena
from brakeline.sim.ground_realtime import SpinningLidar
from brakeline.sim.lidar import Lidar
from tests.robots import GROUND

BEAMS = 360
MOUNT = PlanarPose(-0.032, 0.0, 0.0)
ERRORS = HitErrors.of(GROUND, 0.02)
NEAR = 0.6  # m: closer than this there is no gap between two hits on one wall that the body fits through
EDGE = 0.15  # m: neighbouring beams that differ by more are on both sides of an edge


def scan_of(ways, **more):
    n = len(ways)
    fields = {
        "header": header(10.0, "base_scan"),
        "angle_min": 0.0,
        "angle_max": 2.0 * math.pi * (n - 1) / n,
        "angle_increment": 2.0 * math.pi / n,
        "time_increment": 0.0,
        "scan_time": 0.2,
        "range_min": 0.12,
        "range_max": 3.5,
        "ranges": np.asarray(ways, np.float32),
        "intensities": np.zeros(0, np.float32),
    }
    return LaserScan(**fields | more)


def seen(scan, pose=(0.0, 0.0, 0.0), mount=MOUNT, **more):
    """The obstacles of a scan made in one place."""
    beams = read(scan, **more)
    poses = np.tile(pose, (len(beams.times), 1))
    return obstacles(beams, poses, mount, GROUND, ERRORS, np.asarray(pose[:2], float))


def test_what_is_seen_in_random_rooms_is_inside_whatever_the_errors():
    """Dense true beams beside a scan whose ranges, and the pose it is seen from, are as wrong as they may be."""
    rng, looked = np.random.default_rng(0), 0
    angles = np.linspace(0.0, 2.0 * math.pi, 3600, endpoint=False)
    dense = LidarRays(np.stack([np.cos(angles), np.sin(angles)], axis=1), 3.5)
    while looked < 40:
        arena = draw_arena("dense", rng, GROUND)
        close = Lidar(arena, dense)
        lidar = SpinningLidar(arena, rng, 0.0, nearest=0.0)
        for _ in range(30):
            place = rng.uniform(-2.3, 2.3, 2)
            clear = float(arena.shapes.distance(place).min()) - GROUND.footprint
            if not 0.02 < clear < 0.3:
                continue
            looked += 1
            true = np.array([*place, rng.uniform(-math.pi, math.pi), 0.0, 0.0])
            ranges = None
            while ranges is None:
                ranges = lidar.look(true)
            ranges = np.maximum(ranges + rng.choice([-1.0, 1.0]) * ERRORS.range, 0.0)
            wrong = true[:3] + rng.choice([-1.0, 1.0], 3) * GROUND.measurement_bound[:3]
            found = Shapes.of(seen(scan_of(ranges, range_min=0.0), wrong), dim=2)
            sensor = place + MOUNT.x * np.array([math.cos(true[2]), math.sin(true[2])])
            ways = close.cast(sensor, float(true[2]))
            turned = true[2] + angles
            points = sensor + ways[:, None] * np.stack([np.cos(turned), np.sin(turned)], axis=1)
            beside = np.abs(np.diff(ways[::10], append=ways[0])) < EDGE  # of each beam and the next: on one surface
            points = points[(ways < NEAR) & np.repeat(beside, 10)]
            assert len(points) > 0
            assert found.distance(points).min(axis=0).max() <= 1e-9


def test_a_room_is_few_obstacles_and_its_middle_is_free():
    angles = 2.0 * math.pi * np.arange(BEAMS) / BEAMS
    square = 0.8 / np.maximum(np.abs(np.cos(angles)), np.abs(np.sin(angles)))
    found = seen(scan_of(square), mount=PlanarPose())
    assert 4 <= len(found) <= 12
    assert Shapes.of(found, dim=2).distance(np.zeros((1, 2))).min() > 0.7


@given(
    st.lists(st.tuples(st.floats(-1, 1), st.floats(-1, 1)), min_size=1, max_size=40),
    st.floats(1e-3, 0.1),
)
@settings(deadline=None)
def test_joined_discs_are_all_inside_what_they_are_joined_to(points, radius):
    points = np.array(points)
    radii = radius * np.linspace(1.0, 2.0, len(points))
    shapes = Shapes.of(_joined(points, radii, 0.2), dim=2)
    around = np.linspace(0.0, 2.0 * math.pi, 24)
    rims = points[:, None] + radii[:, None, None] * np.stack([np.cos(around), np.sin(around)], axis=1)
    assert shapes.distance(rims.reshape(-1, 2)).min(axis=0).max() <= 1e-9


def test_between_neighbours_that_the_body_cannot_pass_nothing_is_free():
    shapes = Shapes.of(_joined(np.array([[0.5, -0.1], [0.5, 0.1]]), np.full(2, 0.01), 0.21), dim=2)
    assert shapes.distance(np.array([[0.5, 0.0]])).min() == 0.0
    apart = Shapes.of(_joined(np.array([[0.5, -0.2], [0.5, 0.2]]), np.full(2, 0.01), 0.21), dim=2)
    assert apart.distance(np.array([[0.5, 0.0]])).min() > 0.1


@pytest.mark.parametrize("dumb", [math.nan, 0.0, 0.05, -math.inf, -1.0])
def test_a_beam_that_says_nothing_has_something_at_the_body(dumb):
    ranges = np.full(BEAMS, math.inf)
    assert seen(scan_of(ranges)) == ()
    ranges[90] = dumb
    shapes = Shapes.of(seen(scan_of(ranges)), dim=2)
    assert shapes.distance(np.array([[0.0, GROUND.footprint + 0.005]])).min() == 0.0
    assert shapes.distance(np.zeros((1, 2))).min() >= GROUND.footprint - 1e-9


def test_zero_is_free_only_if_that_is_said():
    assert seen(scan_of(np.zeros(BEAMS)), zero_is_free=True) == ()
    assert seen(scan_of(np.zeros(BEAMS))) != ()


def test_where_no_beam_looks_is_occupied():
    fan = scan_of(np.full(180, math.inf), angle_min=-0.5 * math.pi, angle_increment=math.pi / 179)
    shapes = Shapes.of(seen(fan), dim=2)
    assert shapes.distance(np.array([[-0.12, 0.0]])).min() == 0.0
    assert shapes.distance(np.array([[0.3, 0.0]])).min() > 0.1


def test_beyond_what_a_short_sighted_sensor_sees_nothing_is_free():
    shapes = Shapes.of(seen(scan_of(np.full(BEAMS, math.inf), range_max=0.5)), dim=2)
    assert shapes.distance(np.array([[0.47, 0.0]])).min() == 0.0


def test_beams_are_placed_where_the_robot_was_at_their_time():
    ranges = np.full(BEAMS, math.inf)
    ranges[0] = ranges[180] = 0.5
    beams = read(scan_of(ranges, time_increment=0.2 / BEAMS))
    poses = np.zeros((BEAMS, 3))
    poses[:, 0] = 0.25 * (beams.times - 10.0)  # driving at 0.25 m/s
    found = obstacles(beams, poses, PlanarPose(), GROUND, ERRORS, poses[-1, :2])
    assert sorted(o.position[0] for o in found) == pytest.approx([-0.475, 0.5])


@pytest.mark.parametrize(
    "wrong",
    [
        {"ranges": np.zeros(1, np.float32)},
        {"ranges": np.zeros(20_000, np.float32)},
        {"angle_increment": 0.0},
        {"angle_increment": 1e-9},
        {"angle_increment": math.nan},
        {"angle_min": math.inf},
        {"range_min": -1.0},
        {"range_max": 0.0},
        {"time_increment": math.nan},
    ],
)
def test_a_scan_that_makes_no_sense_is_refused(wrong):
    with pytest.raises(BadScan):
        read(scan_of(np.full(BEAMS, 1.0), **wrong))

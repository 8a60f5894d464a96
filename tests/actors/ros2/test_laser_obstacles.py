"""The obstacles of a scan contain everything that a beam may have hit."""

import itertools
import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from brakeline.actors.ros2.laser_beams import read
from brakeline.actors.ros2.laser_obstacles import HitErrors, _joined, obstacles
from brakeline.actors.ros2.ros2_settings import SensorSettings
from brakeline.actors.ros2.sensor_frames import PlanarPose
from brakeline.errors import BadShape
from brakeline.messaging.obstacle import CYLINDER, Obstacle, Shapes, rotate
from brakeline.messaging.ray_directions import LidarRays
from brakeline.sim.arena_generator import draw_arena
from brakeline.sim.ground_realtime import SpinningLidar
from brakeline.sim.lidar import Lidar
from tests.actors.ros2.test_ros_inputs import BEAMS, scan_of
from tests.robots import GROUND
from tests.safety.ray_casting import cast

MOUNT = PlanarPose(-0.032, 0.0, 0.0)
ERRORS = HitErrors.of(GROUND, 0.02)
NEAR = 0.6  # m: closer than this there is no gap between two hits on one wall that the body fits through
EDGE = 0.15  # m: neighbouring beams that differ by more are on both sides of an edge


def obstacles_of(scan, at=(0.0, 0.0, 0.0), mount=MOUNT):
    """Return the obstacles of a scan that a robot makes while it stands."""
    beams = read(scan)
    poses = np.tile(at, (len(beams.times), 1))
    return obstacles(beams, poses, mount, GROUND, ERRORS, np.asarray(at[:2], float))


@pytest.mark.parametrize("wrong", [math.nan, math.inf, -0.01])
def test_a_range_error_or_a_place_of_the_lidar_that_is_no_number_never_hides_an_obstacle(wrong):
    """With a NaN, no hit was near the robot: a room full of obstacles was free."""
    with pytest.raises(ValueError, match="range_error"):
        SensorSettings(range_error=wrong)
    with pytest.raises(ValueError, match="least_width"):
        SensorSettings(least_width=2.0 if wrong < 0.0 else wrong)  # 2 cm: unknown directions were free
    if not math.isfinite(wrong):
        with pytest.raises(ValueError, match="x = "):
            SensorSettings(mount=PlanarPose(wrong, 0.0, 0.0))
        with pytest.raises(BadShape), np.errstate(invalid="ignore"):
            obstacles_of(scan_of(np.full(BEAMS, 0.5)), mount=PlanarPose(wrong, 0.0, 0.0))


def test_obstacles_contain_all_hits_in_random_rooms_with_the_largest_errors():
    """Compare exact dense beams with a scan whose ranges and pose have the largest errors."""
    rng, positions = np.random.default_rng(0), 0
    angles = np.linspace(0.0, 2.0 * math.pi, 3600, endpoint=False)
    dense = LidarRays(np.stack([np.cos(angles), np.sin(angles)], axis=1), 3.5)
    while positions < 40:
        arena = draw_arena("dense", rng, GROUND)
        close = Lidar(arena, dense)
        lidar = SpinningLidar(arena, rng, 0.0, nearest=0.0)
        for _ in range(30):
            place = rng.uniform(-2.3, 2.3, 2)
            clear = float(arena.shapes.distance(place).min()) - GROUND.footprint
            if not 0.02 < clear < 0.3:
                continue
            positions += 1
            true = np.array([*place, rng.uniform(-math.pi, math.pi), 0.0, 0.0])
            ranges = None
            while ranges is None:
                ranges = lidar.measure_sector(true)
            ranges = np.maximum(ranges + rng.choice([-1.0, 1.0]) * ERRORS.range, 0.0)
            wrong = true[:3] + rng.choice([-1.0, 1.0], 3) * GROUND.measurement_bound[:3]
            shapes = Shapes.of(obstacles_of(scan_of(ranges, range_min=0.0, range_max=3.6), wrong), dim=2)
            sensor = place + MOUNT.x * np.array([math.cos(true[2]), math.sin(true[2])])
            true_ranges = close.cast(sensor, float(true[2]))
            turned = true[2] + angles
            points = sensor + true_ranges[:, None] * np.stack([np.cos(turned), np.sin(turned)], axis=1)
            jumps = np.abs(np.diff(true_ranges[::10], append=true_ranges[0]))
            beside = jumps < EDGE  # a beam and the next one hit one surface
            points = points[(true_ranges < NEAR) & np.repeat(beside, 10)]
            assert len(points) > 0
            assert shapes.distance(points).min(axis=0).max() <= 1e-9


@pytest.mark.parametrize("signs", list(itertools.product((-1.0, 1.0), repeat=4)))
def test_obstacles_contain_the_hits_of_a_lidar_off_centre_with_the_largest_errors(signs):
    """An error of the heading also moves a lidar that is mounted away from the robot's position."""
    mount, angles, *off = PlanarPose(0.6, -0.5), 2.0 * math.pi * np.arange(BEAMS) / BEAMS, *signs
    heading, place = off[2] * GROUND.measurement_bound[2], np.array(off[:2]) * GROUND.measurement_bound[:2]
    directions = rotate(np.stack([np.cos(angles), np.sin(angles)], axis=1), heading)
    sensor = place + rotate(np.array([mount.x, mount.y]), heading)
    around = 2.0 * math.pi * np.arange(24) / 24
    posts = [Obstacle(CYLINDER, tuple(sensor + 0.25 * np.array([math.cos(a), math.sin(a)])), (0.02,)) for a in around]
    ranges = cast(posts, sensor, directions, 3.5)
    scan = scan_of(ranges + off[3] * ERRORS.range, range_max=3.6)
    shapes = Shapes.of(obstacles_of(scan, mount=mount), dim=2)
    hits = (sensor + ranges[:, None] * directions)[ranges < 3.5]
    assert len(hits) > 100 and shapes.distance(hits).min(axis=0).max() <= 1e-9


def test_a_room_is_few_obstacles_and_its_middle_is_free():
    angles = 2.0 * math.pi * np.arange(BEAMS) / BEAMS
    square = 0.8 / np.maximum(np.abs(np.cos(angles)), np.abs(np.sin(angles)))
    boxes = obstacles_of(scan_of(square), mount=PlanarPose())
    assert 4 <= len(boxes) <= 12
    assert Shapes.of(boxes, dim=2).distance(np.zeros((1, 2))).min() > 0.7


@given(st.lists(st.tuples(st.floats(-1, 1), st.floats(-1, 1)), min_size=1, max_size=40), st.floats(1e-3, 0.1))
@settings(deadline=None)
def test_the_boxes_contain_all_discs_that_they_replace(points, radius):
    points = np.array(points)
    radii = radius * np.linspace(1.0, 2.0, len(points))
    shapes = Shapes.of(_joined(points, radii, 0.2), dim=2)
    around = np.linspace(0.0, 2.0 * math.pi, 24)
    rims = points[:, None] + radii[:, None, None] * np.stack([np.cos(around), np.sin(around)], axis=1)
    assert shapes.distance(rims.reshape(-1, 2)).min(axis=0).max() <= 1e-9


def test_a_gap_that_the_body_cannot_pass_is_occupied():
    shapes = Shapes.of(_joined(np.array([[0.5, -0.1], [0.5, 0.1]]), np.full(2, 0.01), 0.21), dim=2)
    assert shapes.distance(np.array([[0.5, 0.0]])).min() == 0.0
    apart = Shapes.of(_joined(np.array([[0.5, -0.2], [0.5, 0.2]]), np.full(2, 0.01), 0.21), dim=2)
    assert apart.distance(np.array([[0.5, 0.0]])).min() > 0.1


@pytest.mark.parametrize("near", [0.05, -math.inf])
@pytest.mark.parametrize("mount", [PlanarPose(), PlanarPose(0.05, 0.08)])
def test_what_is_too_near_to_be_measured_touches_the_body_where_the_beam_leaves_it(near, mount):
    ranges = np.full(BEAMS, math.inf)
    assert obstacles_of(scan_of(ranges), mount=mount) == ()
    ranges[90] = near
    shapes = Shapes.of(obstacles_of(scan_of(ranges), mount=mount), dim=2)
    leaves = np.array([mount.x, math.sqrt(GROUND.footprint**2 - mount.x**2)])
    assert shapes.distance(leaves * (1.0 + 0.005 / GROUND.footprint)) == 0.0
    assert shapes.distance(np.zeros((1, 2))).min() >= GROUND.footprint - 1e-9


def test_what_a_lidar_outside_the_body_is_too_near_to_is_at_the_lidar():
    ranges = np.full(BEAMS, math.inf)
    ranges[180] = -math.inf
    (touching,) = obstacles_of(scan_of(ranges), mount=PlanarPose(0.0, 0.2))
    assert touching.position[0] == pytest.approx(0.0) and touching.position[1] > GROUND.footprint


def test_space_beyond_a_short_range_sensor_is_occupied():
    shapes = Shapes.of(obstacles_of(scan_of(np.full(BEAMS, math.inf), range_max=0.5)), dim=2)
    assert shapes.distance(np.array([[0.47, 0.0]])).min() == 0.0


def test_each_beam_starts_where_the_robot_was_at_its_time():
    ranges = np.full(BEAMS, math.inf)
    ranges[0] = ranges[180] = 0.5
    beams = read(scan_of(ranges, time_increment=0.2 / BEAMS))
    poses = np.zeros((BEAMS, 3))
    poses[:, 0] = 0.25 * (beams.times - 10.0)  # driving at 0.25 m/s
    hits = obstacles(beams, poses, PlanarPose(), GROUND, ERRORS, poses[-1, :2])
    assert sorted(o.position[0] for o in hits) == pytest.approx([-0.475, 0.5])


# rad/s of the robot, and the side to which the lidar turns
TURNS = list(itertools.product((1.5, -1.5, 0.0), (1.0, -1.0)))


@pytest.mark.parametrize("rate, side", TURNS)
def test_hits_are_where_they_are_whichever_way_robot_and_lidar_turn(rate, side):
    """The lidar turns twice a second on a robot that drives along an arc: as if it stood, hits would be off."""
    mount, times = PlanarPose(-0.032, 0.02, 2.0), np.arange(BEAMS) / (2.0 * BEAMS) - 0.25
    headings = 0.7 + rate * times
    places = 0.2 * times[:, None] * np.sinc(0.5 * rate * times / math.pi)[:, None]  # the chord of an arc
    middle = 0.7 + 0.5 * rate * times
    poses = np.column_stack([places * np.stack([np.cos(middle), np.sin(middle)], axis=1), headings])
    beams = read(scan_of(np.full(BEAMS, np.inf), angle_increment=side * 2.0 * math.pi / BEAMS))
    sensor = poses[:, :2] + np.stack([rotate(np.array([mount.x, mount.y]), heading) for heading in headings])
    ways = headings + mount.yaw + beams.angles
    directions = np.stack([np.cos(ways), np.sin(ways)], axis=1)
    around = 2.0 * math.pi * np.arange(8) / 8
    posts = [Obstacle(CYLINDER, (0.6 * math.cos(a), 0.6 * math.sin(a)), (0.05,)) for a in around]
    ranges = np.array([cast(posts, at, way[None], 3.5)[0] for at, way in zip(sensor, directions, strict=True)])
    beams, exact = replace(beams, ranges=ranges), HitErrors(0.0, 0.0, 0.0)
    hits = (sensor + ranges[:, None] * directions)[ranges < 3.5]
    shapes = Shapes.of(obstacles(beams, poses, mount, GROUND, exact, np.zeros(2)), 2)
    assert len(hits) > 50 and shapes.distance(hits).min(axis=0).max() <= 1e-9
    assert shapes.distance(0.6 * np.stack([np.cos(around + 0.39), np.sin(around + 0.39)], axis=1)).min() > 0.05
    as_if_it_stood = obstacles(beams, np.tile(poses[BEAMS // 2], (BEAMS, 1)), mount, GROUND, exact, np.zeros(2))
    assert rate == 0.0 or Shapes.of(as_if_it_stood, 2).distance(hits).min(axis=0).max() > 0.1


@pytest.mark.parametrize("rate, side", TURNS)
def test_an_obstacle_that_ends_just_before_the_next_beam_is_contained_to_its_end(rate, side):
    """A robot that turns with its lidar spreads the beams; one that drives moves them apart."""
    beams = read(scan_of(np.full(BEAMS, np.inf), angle_increment=side * 2.0 * math.pi / BEAMS))
    times, poses = np.arange(BEAMS) / (2.0 * BEAMS), np.zeros((BEAMS, 3))
    poses[:, 0], poses[:, 2] = side * 2.0 * times, rate * times
    last = int(np.argmin(np.abs(np.abs(poses[:, 2] + beams.angles) - 1.5 * math.pi)))  # to the side, across the way
    ways = poses[:, 2] + beams.angles
    hit, beyond = (poses[i, :2] + 0.8 * np.array([math.cos(ways[i]), math.sin(ways[i])]) for i in (last, last + 1))
    beams = replace(beams, ranges=np.where(np.arange(BEAMS) == last, 0.8, beams.ranges))
    shapes = Shapes.of(obstacles(beams, poses, PlanarPose(), GROUND, HitErrors(0.0, 0.0, 0.0), hit), 2)
    assert shapes.distance((0.01 * hit + 0.99 * beyond)[None]).min() <= 1e-9


@pytest.mark.parametrize("turn", [1, -1])
def test_an_obstacle_that_ends_between_the_last_beam_and_the_first_is_contained_to_its_end(turn):
    """The lidar turns ten times a second on a robot at 0.25 m/s: its last beam begins 25 mm ahead of the first."""
    beams, poses = read(scan_of(np.full(BEAMS, np.inf))), np.zeros((BEAMS, 3))
    poses[:, 0] = turn * np.linspace(-0.0125, 0.0125, BEAMS)
    angles = 0.5 * math.pi + turn * beams.gap * np.arange(BEAMS)
    wall = Obstacle("box", (turn * 0.069, 0.6), (0.162, 0.2))  # its end is in the strip that no beam crosses
    directions = np.stack([np.cos(angles), np.sin(angles)], axis=1)
    ranges = [cast([wall], pose[:2], direction, 3.5) for pose, direction in zip(poses, directions, strict=True)]
    assert ranges[0] == 3.5 and ranges[-1] < 0.6
    beams = replace(beams, angles=angles, ranges=np.array(ranges))
    found = obstacles(beams, poses, PlanarPose(), GROUND, HitErrors(0.0, 0.0, 0.0), np.zeros(2))
    front = np.stack([turn * np.linspace(-0.012, 0.15, 50), np.full(50, 0.5)], axis=1)
    assert float(Shapes.of(found, 2).distance(front).min(axis=0).max()) < 1e-3

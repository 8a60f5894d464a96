"""Beams without information: what may be there is in a box, or the scan is refused."""

import math
from dataclasses import replace

import numpy as np
import pytest

from brakeline.actors.ros2.laser_beams import read
from brakeline.actors.ros2.laser_obstacles import HitErrors, obstacles
from brakeline.actors.ros2.sensor_frames import PlanarPose
from brakeline.actors.ros2.unknown_space import UnknownSpace
from brakeline.errors import BadScan
from brakeline.messaging.obstacle import CYLINDER, Obstacle, Shapes
from brakeline.messaging.ros2 import cdr_messages as cdr
from tests.actors.ros2.test_ros_inputs import BEAMS, scan_of
from tests.robots import GROUND
from tests.safety.ray_casting import cast

ERRORS = HitErrors.of(GROUND, 0.02)
EXACT = replace(ERRORS, range=0.0, heading=0.0, position=0.0)
MOUNT = PlanarPose(-0.032, 0.0, 0.0)
WIDTH = 0.02  # m, of the thinnest obstacle
TURN = 0.2  # s, of the lidar
NEAR = 0.9  # m
FAR = 3.5  # m


def space(errors=ERRORS, width=WIDTH):
    return UnknownSpace(GROUND, errors, width)


def boxes_of(unknown, scan, poses=None, mount=MOUNT):
    """Return the boxes of a scan; poses: of its beams, by default at the origin."""
    beams = read(scan)
    poses = np.zeros((len(beams.angles), 3)) if poses is None else poses
    return unknown.boxes(beams, poses, mount, poses[-1, :2])


def free_but(*blind, n=BEAMS):
    ranges = np.full(n, math.inf)
    ranges[list(blind)] = math.nan
    return scan_of(ranges)


def test_a_beam_without_information_is_a_box_from_where_an_obstacle_could_be_missed():
    assert boxes_of(space(), scan_of(np.full(BEAMS, math.inf))) == ()
    (box,) = boxes_of(space(), free_but(0))
    step = 2.0 * math.radians(360.0 / BEAMS)
    hiding = WIDTH * math.cos(0.25 * math.pi + step) / math.sin(step)
    begin = box.position[0] - 0.5 * box.size[0] - MOUNT.x
    assert hiding - 0.06 < begin < hiding and box.position[1] == pytest.approx(0.0, abs=1e-9)
    assert box.position[0] + 0.5 * box.size[0] > GROUND.sight
    wide = boxes_of(space(), free_but(0, 1))
    assert 0.0 < wide[0].position[0] - 0.5 * wide[0].size[0] < begin + MOUNT.x


def test_unknown_space_at_the_body_is_refused_with_the_count():
    with pytest.raises(BadScan, match=f"no information in 20 of {BEAMS} directions"):
        boxes_of(space(), free_but(*range(20)))
    with pytest.raises(BadScan, match=f"no information in {BEAMS} of {BEAMS} directions"):
        boxes_of(space(), free_but(*range(BEAMS)))
    above = np.full(BEAMS, 65.533)
    with pytest.raises(BadScan, match=r"360 ranges are above range_max, 3\.5 m: REP 117 wants inf for no hit"):
        boxes_of(space(), scan_of(above))


@pytest.mark.parametrize("sign", [-1.0, 1.0])
def test_directions_that_a_scan_leaves_out_are_unknown(sign):
    step = sign * math.pi / 180
    with pytest.raises(BadScan, match="no information in 90 of 360 directions"):
        boxes_of(space(), scan_of(np.full(270, math.inf), angle_min=-135.0 * step, angle_increment=step))
    for beams in (359, 360, 361):  # rounding, and beams that repeat the first
        scan = scan_of(np.full(beams, math.inf), angle_increment=sign * 2.0 * math.pi / 359.4)
        assert boxes_of(space(), scan) == ()


def test_what_an_earlier_scan_showed_to_be_free_is_free_until_the_poses_jump():
    unknown, glass = space(), free_but(*range(20))
    assert boxes_of(unknown, free_but()) == ()
    boxes = boxes_of(unknown, glass)
    assert len(boxes) > 3 and Shapes.of(boxes, 2).distance(np.array([[0.3, 0.0]])).min() > 0.05
    unknown.reset()
    with pytest.raises(BadScan):
        boxes_of(unknown, glass)


def test_the_memory_ends_after_two_seconds():
    """Something dark that was put before a standing robot was free space: an older scan showed none."""
    unknown, later = space(), cdr.header(12.5, "base_scan")
    boxes_of(unknown, free_but())
    with pytest.raises(BadScan):
        boxes_of(unknown, replace(free_but(*range(20)), header=later))


def test_nothing_around_the_body_is_free_at_the_start_if_nobody_saw_it():
    """A memory of an episode assumes a ring of 0.1 m. A node may start, or its poses jump, beside a pane of glass."""
    with pytest.raises(BadScan):
        boxes_of(space(EXACT), free_but(*range(20)))


@pytest.mark.parametrize("beams", [180, 1440, 3999])
def test_scans_with_few_or_many_beams(beams):
    assert boxes_of(space(), scan_of(np.full(beams, math.inf))) == ()
    assert 1 <= len(boxes_of(space(width=0.05), free_but(*range(-(-beams // 360)), n=beams))) <= 3


def turned_by(rate):
    """Return the poses of the beams of a robot that turns on the spot [rad/s]."""
    poses = np.zeros((BEAMS, 3))
    poses[:, 2] = rate * TURN * np.arange(BEAMS) / BEAMS
    return poses


def test_a_turn_against_the_turn_of_the_lidar_leaves_a_gap_between_its_last_beam_and_its_first():
    """A post that stood in the gap was in no obstacle: the scan counted as one of a whole turn."""
    angles, poses = 2.0 * math.pi * np.arange(BEAMS) / BEAMS, turned_by(-0.5)
    post = Obstacle(CYLINDER, (0.4 * math.cos(-0.055), 0.4 * math.sin(-0.055)), (0.015,))
    seen = poses[:, 2] + angles
    ranges = cast([post], np.zeros(2), np.stack([np.cos(seen), np.sin(seen)], axis=1), FAR)
    assert (ranges == FAR).all(), "no beam hits it"
    scan = scan_of(np.full(BEAMS, math.inf))
    with pytest.raises(BadScan, match="no information in 6 of 366 directions"):
        boxes_of(space(), scan, poses, PlanarPose())
    boxes = boxes_of(space(EXACT), scan, poses, PlanarPose())
    assert Shapes.of(boxes, 2).distance(np.array([post.position])).min() == 0.0
    assert boxes_of(space(EXACT), scan, turned_by(0.5), PlanarPose()) == (), "the other way, beams overlap"
    unknown = space(EXACT)
    before = cast([post], np.zeros(2), np.stack([np.cos(angles), np.sin(angles)], axis=1), FAR)
    boxes_of(unknown, scan_of(np.where(before < FAR, before, math.inf)), None, PlanarPose())
    boxes = boxes_of(unknown, scan, poses, PlanarPose())
    assert Shapes.of(boxes, 2).distance(np.array([post.position])).min() == 0.0


def test_all_that_beams_without_information_may_have_missed_is_in_an_obstacle():
    """Drive among thin posts, half of them black: a beam that hits one of those, and some others, return nothing.

    All errors are the largest. The judge casts ten times as many beams, all of which return.
    """
    rng, scans, covered = np.random.default_rng(3), 0, 0
    for _ in range(8):
        accepted, points = drive_among_posts(rng)
        scans, covered = scans + accepted, covered + points
    assert scans > 20 and covered > 100


def drive_among_posts(rng, periods=6):
    """Return how many scans were accepted, and how many true hits in unknown directions their obstacles contain."""
    angles = 2.0 * math.pi * np.arange(BEAMS) / BEAMS
    radius = rng.uniform(0.0145, 0.06, 14)
    bearing, away = rng.uniform(-math.pi, math.pi, 14), rng.uniform(0.3, 1.2, 14) + radius
    posts = [
        Obstacle(CYLINDER, (d * math.cos(b), d * math.sin(b)), (r,))
        for d, b, r in zip(away, bearing, radius, strict=True)
    ]
    black, unknown = posts[:7], space()
    share, speed, rate = rng.choice([0.0, 0.02, 0.08]), rng.choice([0.0, 0.2]), rng.choice([-0.5, 0.0, 0.5])
    pose, accepted, covered = np.array([0.0, 0.0, rng.uniform(-math.pi, math.pi)]), 0, 0
    for period in range(periods):
        time = TURN * np.arange(BEAMS) / BEAMS
        way = speed * time
        places = pose[0] + way * math.cos(pose[2]), pose[1] + way * math.sin(pose[2]), pose[2] + rate * time
        poses = np.stack(places, axis=1)
        pose = poses[-1] + [0.0, 0.0, rate * TURN / BEAMS]
        if Shapes.of(posts, 2).distance(pose[None, :2]).min() < GROUND.footprint + 0.01:
            break
        sensors = poses[:, :2] + MOUNT.x * np.stack([np.cos(poses[:, 2]), np.sin(poses[:, 2])], axis=1)
        ways = np.stack([np.cos(poses[:, 2] + angles), np.sin(poses[:, 2] + angles)], axis=1)
        ranges = np.array([cast(posts, at, way[None], FAR)[0] for at, way in zip(sensors, ways, strict=True)])
        dark = np.array([cast(black, at, way[None], FAR)[0] for at, way in zip(sensors, ways, strict=True)])
        ranges = np.where(ranges < FAR, np.maximum(ranges + rng.choice([-1.0, 1.0]) * ERRORS.range, 1e-3), np.inf)
        silent = ((dark < FAR) & (dark <= ranges + 0.021)) | (rng.random(BEAMS) < share)
        silent &= period >= 2  # what the first scans show is in the memory
        ranges[silent] = math.nan
        wrong = poses + rng.choice([-1.0, 1.0], 3) * GROUND.measurement_bound[:3] * [0.7, 0.7, 1.0]
        beams = read(scan_of(ranges, range_min=0.0, header=cdr.header(10.0 + TURN * period, "base_scan")))
        try:
            boxes = unknown.boxes(beams, wrong, MOUNT, wrong[-1, :2])
        except BadScan:
            continue
        accepted += 1
        known = beams.known
        hits = obstacles(beams.take(known), wrong[known], MOUNT, GROUND, ERRORS, wrong[-1, :2])
        points = judged(posts, sensors[-1], poses, angles, silent)
        if len(points):
            gap = Shapes.of((*hits, *boxes), 2).distance(points).min(axis=0)
            assert gap.max() <= 1e-9, f"{points[gap.argmax()]} is {gap.max():.3f} m from all obstacles"
            covered += len(points)
    return accepted, covered


def judged(posts, sensor, poses, angles, silent):
    """Return the true hits (n, 2) near the sensor, in directions between two silent beams or beside one."""
    fine = 2.0 * math.pi * np.arange(10 * BEAMS) / (10 * BEAMS)
    ways = np.stack([np.cos(fine), np.sin(fine)], axis=1)
    ranges = cast(posts, sensor, ways, FAR)
    beam = np.argmin(np.abs(np.angle(np.exp(1j * (fine[:, None] - (poses[:, 2] + angles)[None])))), axis=1)
    chosen = (ranges < NEAR) & silent[beam]
    return sensor + ranges[chosen, None] * ways[chosen]

"""Beams without information: what may be there is in a box, or the scan is refused."""

import math
from dataclasses import replace

import numpy as np
import pytest

from brakeline.actors.ros2.laser_beams import read
from brakeline.actors.ros2.laser_obstacles import HitErrors, obstacles
from brakeline.actors.ros2.sensor_frames import PlanarPose
from brakeline.actors.ros2.unknown_space import UnknownSpace
from brakeline.errors import BadScan, Mismatch
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


@pytest.mark.parametrize("stated", [0.0, 0.5])
@pytest.mark.parametrize("beams", [3, 12, 23])
def test_a_ring_of_sonars_is_no_lidar(beams, stated):
    """Such a scan was a ValueError about the shapes of arrays."""
    with pytest.raises(BadScan, match=r"beams \d+° apart: those of a lidar are at most 12°"):
        boxes_of(stating(stated) if stated else space(), scan_of(np.full(beams, math.inf)))


@pytest.mark.parametrize("beams", [180, 1440, 3999])
def test_scans_with_few_or_many_beams(beams):
    assert boxes_of(space(), scan_of(np.full(beams, math.inf))) == ()
    assert 1 <= len(boxes_of(space(width=0.05), free_but(*range(-(-beams // 360)), n=beams))) <= 3


def fed(unknown, at, pose):
    """Return the boxes after a scan of 270° in front that hits nothing."""
    step, header = math.pi / 180.0, cdr.header(at, "s")
    scan = scan_of(np.full(270, math.inf), header=header, angle_min=-135.0 * step, angle_increment=step)
    return boxes_of(unknown, scan, np.tile(pose, (270, 1)))


def stating(radius=0.5):
    return UnknownSpace(GROUND, ERRORS, WIDTH, radius)


def test_a_robot_that_sees_270_degrees_moves_where_somebody_stated_that_space_is_free_or_where_it_saw_that():
    """Standing, driving and turning were refused alike, for ever."""
    with pytest.raises(BadScan, match=r"no information in 90 of 360 directions.*state it \(--free-at-start\)"):
        fed(space(), 10.0, (0.0, 0.0, 0.0))
    unknown, pose = stating(), np.zeros(3)
    for k in range(100):  # 10 s without a motion: two seconds of memory would not do
        boxes = fed(unknown, 10.0 + 0.2 * k, pose)
    assert len(boxes) < 40
    nearest = Shapes.of(boxes, 2).distance(np.zeros((1, 2))).min()
    assert 0.35 < nearest < 0.5, "behind the robot, space is free up to what was stated, less the errors"
    for k in range(200):
        pose = pose + ((0.04, 0.0, 0.0) if k % 60 < 20 else (0.0, 0.0, 0.1 if k % 60 < 40 else -0.1))
        boxes = fed(unknown, 40.0 + 0.2 * k, pose)
    assert Shapes.of(boxes, 2).distance(pose[None, :2]).min() > 0.2


def test_space_behind_a_robot_that_was_never_seen_or_stated_stays_occupied():
    unknown = stating(0.3)
    for k in range(20):
        boxes = fed(unknown, 10.0 + 0.2 * k, (0.0, 0.0, 0.0))
    for k in range(1, 4):  # backwards
        last, boxes = boxes, ()
        try:
            boxes = fed(unknown, 14.0 + 0.2 * k, (-0.04 * k, 0.0, 0.0))
        except BadScan as error:
            assert "nobody has seen the space there within the last 4.2 m" in str(error)
            break
    behind = np.array([[-0.31, 0.0], [-0.4, 0.1], [-0.8, 0.0]])
    for now in (last, boxes):
        assert not now or (Shapes.of(now, 2).distance(behind).min(axis=0) == 0.0).all()
    with pytest.raises(BadScan):
        fed(unknown, 20.0, (-0.2, 0.0, 0.0))


def test_what_was_stated_does_not_count_after_a_jump_of_the_poses():
    unknown = stating()
    fed(unknown, 10.0, (0.0, 0.0, 0.0))
    unknown.reset()
    with pytest.raises(
        BadScan, match=r"the poses jumped, so what was free before no longer counts.*start the node again"
    ):
        fed(unknown, 10.2, (0.0, 0.0, 0.0))


def test_a_disc_that_is_hardly_larger_than_the_body_is_refused():
    with pytest.raises(Mismatch, match=r"a free disc of 0\.1 m .* the body reaches 0\.105 m: give 0\.23 m or more"):
        stating(0.1)
    fed(stating(0.23), 10.0, (0.0, 0.0, 0.0))


def test_directions_behind_a_mast_are_blind_but_those_in_which_something_was_seen_are_not():
    """Something dark may have been put in sight of a robot that stands, but not behind its mast."""
    mast = range(170, 200)
    unknown = stating()
    for k in range(30):
        assert boxes_of(unknown, replace(free_but(*mast), header=cdr.header(10.0 + 0.2 * k, "s")))
    with pytest.raises(BadScan, match="no information in 50 of 360 directions"):
        for k in range(30, 60):
            boxes_of(unknown, replace(free_but(*range(20), *mast), header=cdr.header(10.0 + 0.2 * k, "s")))


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


@pytest.mark.parametrize("degrees", [360.0, 270.0, 180.0])
def test_all_that_beams_without_information_may_have_missed_is_in_an_obstacle(degrees):
    """Drive among thin posts, half of them black: a beam that hits one of those, and some others, return nothing.

    All errors are the largest. The judge casts ten times as many beams, all of which return. A robot whose lidar sees
    less than a turn knows at the start that the disc up to the nearest post is free, and drives backwards too.
    """
    rng, scans, covered = np.random.default_rng(3), 0, 0
    for _ in range(8 if degrees == 360.0 else 4):
        accepted, points = drive_among_posts(rng, degrees, 6 if degrees == 360.0 else 8)
        scans, covered = scans + accepted, covered + points
    assert scans > (20 if degrees == 360.0 else 10) and covered > 100, (scans, covered)


def drive_among_posts(rng, degrees, periods):
    """Return how many scans were accepted, and how many true hits in unknown directions their obstacles contain."""
    angles = 2.0 * math.pi * np.arange(BEAMS) / BEAMS
    radius = rng.uniform(0.0145, 0.06, 14)
    bearing, away = rng.uniform(-math.pi, math.pi, 14), rng.uniform(0.3, 1.2, 14) + radius
    posts = [
        Obstacle(CYLINDER, (d * math.cos(b), d * math.sin(b)), (r,))
        for d, b, r in zip(away, bearing, radius, strict=True)
    ]
    outside = np.abs(np.angle(np.exp(1j * angles))) > math.radians(0.5 * degrees)
    stated = 0.0 if degrees == 360.0 else float(Shapes.of(posts, 2).distance(np.zeros((1, 2))).min())
    black, unknown = posts[:7], UnknownSpace(GROUND, ERRORS, WIDTH, stated)
    share, speed, rate = rng.choice([0.0, 0.02, 0.08]), rng.choice([0.0, 0.2]), rng.choice([-0.5, 0.0, 0.5])
    pose, accepted, covered = np.array([0.0, 0.0, rng.uniform(-math.pi, math.pi)]), 0, 0
    for period in range(periods):
        if stated:
            speed, rate = rng.choice([-0.2, 0.0, 0.2]), rng.choice([-0.5, 0.0, 0.5])
        time = TURN * np.arange(BEAMS) / BEAMS
        way = speed * time
        places = pose[0] + way * math.cos(pose[2]), pose[1] + way * math.sin(pose[2]), pose[2] + rate * time
        poses = np.stack(places, axis=1)
        pose = poses[-1] + [0.0, 0.0, rate * TURN / BEAMS]
        if Shapes.of(posts, 2).distance(pose[None, :2]).min() < GROUND.footprint + 0.01:
            break
        sensors = poses[:, :2] + MOUNT.x * np.stack([np.cos(poses[:, 2]), np.sin(poses[:, 2])], axis=1)
        ways = np.stack([np.cos(poses[:, 2] + angles), np.sin(poses[:, 2] + angles)], axis=1)
        ranges, dark = (np.where(outside, FAR, cast(hit, sensors, ways, FAR)) for hit in (posts, black))
        ranges = np.where(ranges < FAR, np.maximum(ranges + rng.choice([-1.0, 1.0]) * ERRORS.range, 1e-3), np.inf)
        silent = ((dark < FAR) & (dark <= ranges + 0.021)) | (rng.random(BEAMS) < share)
        silent &= period >= 2  # what the first scans show is in the memory
        silent |= outside
        ranges[silent] = math.nan
        wrong = poses + rng.choice([-1.0, 1.0], 3) * GROUND.measurement_bound[:3] * [0.7, 0.7, 1.0]
        beams = read(scan_of(ranges, range_min=0.0, header=cdr.header(10.0 + TURN * period, "base_scan")))
        try:
            boxes = unknown.boxes(beams, wrong, MOUNT, wrong[-1, :2])
        except BadScan:
            continue
        accepted += 1
        if stated and period % 4 != 3:
            continue
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
    beam = np.argmin(np.abs(np.angle(np.exp(1j * (fine[:, None] - (poses[:, 2] + angles)[None])))), axis=1)
    fine = fine[silent[beam]]
    ways = np.stack([np.cos(fine), np.sin(fine)], axis=1)
    ranges = cast(posts, sensor, ways, FAR)
    chosen = ranges < NEAR
    return sensor + ranges[chosen, None] * ways[chosen]

"""Odometry, frames, freshness: what there is to decide on, and what is missing."""

import math

import numpy as np
import pytest

from brakeline.actors.ros2.odometry import KEPT, OdometryHistory
from brakeline.actors.ros2.ros_clock import SimulatedClock, SystemClock
from brakeline.actors.ros2.ros_inputs import AgeLimits, InputMissing, RosInputs, SensorSettings
from brakeline.actors.ros2.sensor_frames import PlanarPose, TransformTree
from brakeline.messaging.ros2.cdr_messages import (
    Clock,
    Odometry,
    PoseWithCovariance,
    Quaternion,
    TFMessage,
    Transform,
    TransformStamped,
    TwistStamped,
    TwistWithCovariance,
    header,
    pose,
    quaternion,
    time_of,
    twist,
    vector,
)
from tests.actors.ros2.test_laser import BEAMS, scan_of
from tests.robots import GROUND

ROBOT = GROUND.in_real_time()


def odometry(at, x=0.0, y=0.0, yaw=0.0, speed=0.0, turn_rate=0.0):
    none = np.zeros(36)
    return Odometry(
        header=header(at, "odom"),
        child_frame_id="base_footprint",
        pose=PoseWithCovariance(pose=pose(x, y, yaw), covariance=none),
        twist=TwistWithCovariance(twist=twist(speed, turn_rate), covariance=none),
    )


def transform(parent, child, x=0.0, y=0.0, rotation=None, at=0.0):
    moved = Transform(translation=vector(x, y), rotation=rotation or quaternion(0.0))
    return TransformStamped(header=header(at, parent), child_frame_id=child, transform=moved)


def test_a_track_gives_states_between_and_a_little_after():
    track = OdometryHistory()
    for i in range(11):
        assert track.add(0.1 * i, 0.02 * i, 0.0, 0.0, 0.2, 0.0)
    assert track.state(0.55) == pytest.approx([0.11, 0.0, 0.0, 0.2, 0.0])
    assert track.state(1.05) == pytest.approx([0.21, 0.0, 0.0, 0.2, 0.0])
    assert track.state(1.2) is None and track.state(-0.1) is None


def test_a_track_carries_on_along_the_arc_and_turns_through_pi():
    track = OdometryHistory()
    track.add(0.0, 0.0, 0.0, 3.1, 0.2, 0.5)
    track.add(0.1, 0.0, 0.0, -3.13, 0.2, 0.5)
    assert track.state(0.05)[2] == pytest.approx(-3.1566 + 2.0 * math.pi, abs=1e-3)
    assert track.state(0.18)[2] == pytest.approx(-3.09, abs=1e-6)


def test_a_track_keeps_its_length_and_begins_anew_when_time_goes_back():
    track = OdometryHistory()
    for i in range(1000):
        track.add(0.01 * i, 0.0, 0.0, 0.0, 0.0, 0.0)
    assert len(track) <= KEPT / 0.01 + 2
    assert not track.add(9.5, 0.0, 0.0, 0.0, 0.0, 0.0) and not track.add(math.nan, 0, 0, 0, 0, 0)
    assert track.add(1.0, 0.0, 0.0, 0.0, 0.0, 0.0) and len(track) == 1


def test_speeds_come_from_poses_where_there_are_none():
    track = OdometryHistory()
    for i in range(50):
        angle = 0.4 * 0.02 * i
        track.add_pose(0.02 * i, 0.5 * math.sin(angle), 0.5 * (1.0 - math.cos(angle)), angle)
    assert track.state(0.9)[3:] == pytest.approx([0.2, 0.4], abs=1e-3)


def test_of_what_was_between_two_odometries_far_apart_nothing_is_known():
    track = OdometryHistory(gap=0.15)
    for at in (0.0, 0.1, 1.1, 1.2):
        track.add(at, 0.2 * at, 0.0, 0.0, 0.2, 0.0)
    assert track.state(0.05) is not None and track.state(1.15) is not None
    assert track.state(0.6) is None and track.at(np.array([0.05, 0.6])) is None
    poses = OdometryHistory(gap=0.15)
    for at in (0.0, 0.05, 0.1, 0.15, 1.15, 1.2, 1.25, 1.3):
        poses.add_pose(at, 0.2 * at, 0.0, 0.0)
    assert poses.state(0.05) is None, "of one pose no speed is known"
    assert poses.state(0.12)[3] == pytest.approx(0.2) if poses.state(0.12) is not None else True
    assert poses.state(1.17) is None and poses.state(1.28)[3] == pytest.approx(0.2)


def test_frames_are_followed_up_and_down():
    frames = TransformTree()
    frames.add(transform("base_footprint", "base_link", 0.0, 0.1, quaternion(0.5 * math.pi)))
    frames.add(transform("/base_link", "base_scan", 0.2))
    place = frames.place("base_scan", "base_footprint")
    assert (place.x, place.y, place.yaw) == pytest.approx((0.0, 0.3, 0.5 * math.pi))
    back = frames.place("base_footprint", "base_scan")
    assert (back.then(place).x, back.then(place).y, back.then(place).yaw) == pytest.approx((0.0, 0.0, 0.0))
    assert frames.place("camera", "base_footprint") is None


def test_a_sensor_that_hangs_upside_down_or_a_loop_of_frames_has_no_place():
    frames = TransformTree()
    frames.add(transform("base", "scan", rotation=Quaternion(x=1.0, y=0.0, z=0.0, w=0.0)))
    assert frames.place("scan", "base") is None
    frames.add(transform("a", "b"))
    frames.add(transform("b", "a"))
    assert frames.place("a", "base") is None


@pytest.fixture
def senses():
    """With odometry, a scan and a command of t = 10 s."""
    made = RosInputs(ROBOT, SensorSettings(mount=PlanarPose()), AgeLimits())
    for i in range(101):
        made.hear_odometry(odometry(9.0 + 0.01 * i, x=0.001 * i))
    made.hear_scan(scan_of(np.full(BEAMS, math.inf)))
    made.hear_command(twist(0.2, 0.1), 10.0)
    return made


def test_what_is_fresh_is_decided_on(senses):
    assert senses.state(9.95, 10.05) == pytest.approx([0.095, 0.0, 0.0, 0.0, 0.0])
    assert senses.obstacles(np.zeros(2), 10.05) == ()
    assert senses.command(10.05).action.tolist() == [0.2, 0.1]


@pytest.mark.parametrize(
    ("now", "said"),
    [(10.2, "odometry is 0.20 s old"), (5000.0, "compare the clocks"), (9.9, "odometry is 0.10 s in the future")],
)
def test_odometry_of_another_time_is_none(senses, now, said):
    with pytest.raises(InputMissing, match=said):
        senses.state(9.95, now)


def test_a_scan_of_another_time_is_none(senses):
    with pytest.raises(InputMissing, match=r"the scan is 0\.70 s old"):
        senses.obstacles(np.zeros(2), 10.7)


def test_a_command_counts_for_a_while(senses):
    assert senses.command(10.6) is None
    senses.hear_command(twist(math.nan, 0.0), 10.6)
    assert not np.isfinite(senses.command(10.6).action).all(), "the filter answers it"
    senses.hear_command(TwistStamped(header=header(0.0, ""), twist=twist(0.1, 0.0)), 10.7)
    assert senses.command(10.7).action.tolist() == [0.1, 0.0]


def test_what_never_came_is_named():
    bare = RosInputs(ROBOT, SensorSettings(), AgeLimits())
    with pytest.raises(InputMissing, match="no odometry yet"):
        bare.state(0.0, 0.0)
    with pytest.raises(InputMissing, match="no scan yet"):
        bare.obstacles(np.zeros(2), 0.0)
    bare.hear_scan(scan_of(np.full(BEAMS, 1.0)))
    with pytest.raises(InputMissing, match="no odometry of when the scan was made"):
        bare.obstacles(np.zeros(2), 10.1)
    bare.hear_odometry(odometry(10.0))
    with pytest.raises(InputMissing, match="from 'base_footprint' to 'base_scan'"):
        bare.obstacles(np.zeros(2), 10.1)
    bare.hear_fixed_transforms(TFMessage(transforms=[transform("base_footprint", "base_scan", -0.03)]))
    assert bare.obstacles(np.zeros(2), 10.1)
    bare.hear_scan(scan_of(np.full(BEAMS, 1.0), angle_increment=0.0))
    with pytest.raises(InputMissing, match="no scan that makes sense"):
        bare.obstacles(np.zeros(2), 10.1)


def test_tf_stands_for_odometry():
    made = RosInputs(ROBOT, SensorSettings(base_frame="base"), AgeLimits())
    for i in range(30):
        made.hear_transforms(
            TFMessage(
                transforms=[
                    transform("map", "odom", 5.0, at=0.02 * i),
                    transform("odom", "base", 0.004 * i, at=0.02 * i),
                ]
            )
        )
    assert made.state(0.5, 0.58) == pytest.approx([0.1, 0.0, 0.0, 0.2, 0.0], abs=1e-6)


def test_a_clock_that_was_set_forgets_and_says_by_how_much(monkeypatch):
    simulated = SimulatedClock()
    for told in (100.0, 99.9, 101.0):
        simulated.hear(Clock(clock=time_of(told)))
    assert simulated.now() == 101.0 and simulated.jumped() == 0.0
    simulated.hear(Clock(clock=time_of(5.0)))
    assert simulated.now() == 5.0 and simulated.jumped() == pytest.approx(-96.0) and simulated.jumped() == 0.0
    date = SystemClock()
    before = date.now()
    real = date._offset
    date._offset = real - 7.0
    assert date.jumped() == pytest.approx(7.0, abs=0.04) and date.now() >= before

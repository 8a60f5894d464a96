"""Odometry, transforms and age limits: the inputs of a decision, and the reasons for which they are missing."""

import math

import numpy as np
import pytest

from brakeline.actors.ros2.odometry import HISTORY, OdometryHistory
from brakeline.actors.ros2.ros_clock import RosSimulatedClock, SystemClock
from brakeline.actors.ros2.ros_inputs import AgeLimits, RosInputs, SensorSettings
from brakeline.actors.ros2.sensor_frames import PlanarPose, TransformTree
from brakeline.errors import InputMissing
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
from tests.actors.ros2.test_laser_obstacles import BEAMS, scan_of
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


def test_states_are_interpolated_and_extrapolated_a_little():
    history = OdometryHistory()
    for i in range(11):
        assert history.add(0.1 * i, 0.02 * i, 0.0, 0.0, 0.2, 0.0)
    assert history.state(0.55) == pytest.approx([0.11, 0.0, 0.0, 0.2, 0.0])
    assert history.state(1.05) == pytest.approx([0.21, 0.0, 0.0, 0.2, 0.0])
    assert history.state(1.2) is None and history.state(-0.1) is None


def test_extrapolation_follows_the_arc_and_headings_pass_through_pi():
    history = OdometryHistory()
    history.add(0.0, 0.0, 0.0, 3.1, 0.2, 0.5)
    history.add(0.1, 0.0, 0.0, -3.13, 0.2, 0.5)
    assert history.state(0.05)[2] == pytest.approx(-3.1566 + 2.0 * math.pi, abs=1e-3)
    assert history.state(0.18)[2] == pytest.approx(-3.09, abs=1e-6)


def test_the_history_is_bounded_and_restarts_when_time_goes_back():
    history = OdometryHistory()
    for i in range(1000):
        history.add(0.01 * i, 0.0, 0.0, 0.0, 0.0, 0.0)
    assert len(history) <= HISTORY / 0.01 + 2
    assert not history.add(9.5, 0.0, 0.0, 0.0, 0.0, 0.0) and not history.add(math.nan, 0, 0, 0, 0, 0)
    assert history.add(1.0, 0.0, 0.0, 0.0, 0.0, 0.0) and len(history) == 1


def test_speeds_are_computed_from_poses_without_speeds():
    history = OdometryHistory()
    for i in range(50):
        angle = 0.4 * 0.02 * i
        history.add_pose(0.02 * i, 0.5 * math.sin(angle), 0.5 * (1.0 - math.cos(angle)), angle)
    assert history.state(0.9)[3:] == pytest.approx([0.2, 0.4], abs=1e-3)


def test_no_state_is_interpolated_in_a_long_gap():
    history = OdometryHistory(gap=0.15)
    for at in (0.0, 0.1, 1.1, 1.2):
        history.add(at, 0.2 * at, 0.0, 0.0, 0.2, 0.0)
    assert history.state(0.05) is not None and history.state(1.15) is not None
    assert history.state(0.6) is None and history.at(np.array([0.05, 0.6])) is None
    poses = OdometryHistory(gap=0.15)
    for at in (0.0, 0.05, 0.1, 0.15, 1.15, 1.2, 1.25, 1.3):
        poses.add_pose(at, 0.2 * at, 0.0, 0.0)
    assert poses.state(0.05) is None, "one pose gives no speed"
    assert poses.state(0.12)[3] == pytest.approx(0.2) if poses.state(0.12) is not None else True
    assert poses.state(1.17) is None and poses.state(1.28)[3] == pytest.approx(0.2)


def test_transforms_are_composed_up_and_down_the_tree():
    frames = TransformTree()
    frames.add(transform("base_footprint", "base_link", 0.0, 0.1, quaternion(0.5 * math.pi)))
    frames.add(transform("/base_link", "base_scan", 0.2))
    forward = frames.pose("base_scan", "base_footprint")
    assert (forward.x, forward.y, forward.yaw) == pytest.approx((0.0, 0.3, 0.5 * math.pi))
    identity = frames.pose("base_footprint", "base_scan").compose(forward)
    assert (identity.x, identity.y, identity.yaw) == pytest.approx((0.0, 0.0, 0.0))
    assert frames.pose("camera", "base_footprint") is None


def test_an_inverted_sensor_or_a_loop_of_frames_has_no_pose():
    frames = TransformTree()
    frames.add(transform("base", "scan", rotation=Quaternion(x=1.0, y=0.0, z=0.0, w=0.0)))
    assert frames.pose("scan", "base") is None
    frames.add(transform("a", "b"))
    frames.add(transform("b", "a"))
    assert frames.pose("a", "base") is None


@pytest.fixture
def inputs():
    """Return inputs with odometry, a scan and a command of t = 10 s."""
    inputs = RosInputs(ROBOT, SensorSettings(mount=PlanarPose()), AgeLimits())
    for i in range(101):
        inputs.on_odometry(odometry(9.0 + 0.01 * i, x=0.001 * i))
    inputs.on_scan(scan_of(np.full(BEAMS, math.inf)))
    inputs.on_command(twist(0.2, 0.1), 10.0)
    return inputs


def test_fresh_inputs_are_used(inputs):
    assert inputs.state(9.95, 10.05) == pytest.approx([0.095, 0.0, 0.0, 0.0, 0.0])
    assert inputs.obstacles(np.zeros(2), 10.05) == ()
    assert inputs.command(10.05).action.tolist() == [0.2, 0.1]


@pytest.mark.parametrize(
    ("now", "message"),
    [(10.2, "odometry is 0.20 s old"), (5000.0, "compare the clocks"), (9.9, "odometry is 0.10 s in the future")],
)
def test_odometry_of_another_time_counts_as_missing(inputs, now, message):
    with pytest.raises(InputMissing, match=message):
        inputs.state(9.95, now)


def test_an_old_scan_counts_as_missing(inputs):
    with pytest.raises(InputMissing, match=r"the scan is 0\.70 s old"):
        inputs.obstacles(np.zeros(2), 10.7)


def test_a_command_counts_until_its_age_limit(inputs):
    assert inputs.command(10.6) is None
    inputs.on_command(twist(math.nan, 0.0), 10.6)
    assert not np.isfinite(inputs.command(10.6).action).all(), "the filter has to handle it"
    inputs.on_command(TwistStamped(header=header(0.0, ""), twist=twist(0.1, 0.0)), 10.7)
    assert inputs.command(10.7).action.tolist() == [0.1, 0.0]


def test_the_message_names_the_missing_input():
    bare = RosInputs(ROBOT, SensorSettings(), AgeLimits())
    with pytest.raises(InputMissing, match="no odometry yet"):
        bare.state(0.0, 0.0)
    with pytest.raises(InputMissing, match="no scan yet"):
        bare.obstacles(np.zeros(2), 0.0)
    bare.on_scan(scan_of(np.full(BEAMS, 1.0)))
    with pytest.raises(InputMissing, match="no odometry of when the scan was made"):
        bare.obstacles(np.zeros(2), 10.1)
    bare.on_odometry(odometry(10.0))
    with pytest.raises(InputMissing, match="from 'base_footprint' to 'base_scan'"):
        bare.obstacles(np.zeros(2), 10.1)
    bare.on_fixed_transforms(TFMessage(transforms=[transform("base_footprint", "base_scan", -0.03)]))
    assert bare.obstacles(np.zeros(2), 10.1)
    bare.on_scan(scan_of(np.full(BEAMS, 1.0), angle_increment=0.0))
    with pytest.raises(InputMissing, match="no valid scan"):
        bare.obstacles(np.zeros(2), 10.1)


def test_transforms_can_replace_odometry():
    inputs = RosInputs(ROBOT, SensorSettings(base_frame="base"), AgeLimits())
    for i in range(30):
        inputs.on_transforms(
            TFMessage(
                transforms=[
                    transform("map", "odom", 5.0, at=0.02 * i),
                    transform("odom", "base", 0.004 * i, at=0.02 * i),
                ]
            )
        )
    assert inputs.state(0.5, 0.58) == pytest.approx([0.1, 0.0, 0.0, 0.2, 0.0], abs=1e-6)


def test_a_clock_that_was_set_reports_the_jump_once(monkeypatch):
    simulated = RosSimulatedClock()
    for stamp in (100.0, 99.9, 101.0):
        simulated.on_clock(Clock(clock=time_of(stamp)))
    assert simulated.now() == 101.0 and simulated.jumped() == 0.0
    simulated.on_clock(Clock(clock=time_of(5.0)))
    assert simulated.now() == 5.0 and simulated.jumped() == pytest.approx(-96.0) and simulated.jumped() == 0.0
    clock = SystemClock()
    before = clock.now()
    real = clock._offset
    clock._offset = real - 7.0
    assert clock.jumped() == pytest.approx(7.0, abs=0.04) and clock.now() >= before

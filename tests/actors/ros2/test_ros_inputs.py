"""The inputs of a decision, from scans, odometry and transforms, and the reasons for which they are missing."""

import math
from contextlib import nullcontext

import numpy as np
import pytest

from brakeline.actors.ros2.odometry import HISTORY, OdometryHistory, StepLimits
from brakeline.actors.ros2.ros2_settings import AgeLimits, SensorSettings
from brakeline.actors.ros2.ros_clock import RosSimulatedClock, SystemClock
from brakeline.actors.ros2.ros_inputs import RosInputs
from brakeline.actors.ros2.sensor_frames import MOST_TILT, PlanarPose, TransformTree
from brakeline.errors import InputMissing, PoseJumped
from brakeline.messaging.ros2 import cdr_messages as cdr
from tests.robots import GROUND

BEAMS = 360


def scan_of(beam_ranges, **more):
    n = len(beam_ranges)
    first, step = more.get("angle_min", 0.0), more.get("angle_increment", 2.0 * math.pi / n)
    fields = {
        "header": cdr.header(10.0, "base_scan"),
        "angle_min": first,
        "angle_max": first + (n - 1) * step,
        "angle_increment": step,
        "time_increment": 0.0,
        "scan_time": 0.2,
        "range_min": 0.12,
        "range_max": 3.5,
        "ranges": np.asarray(beam_ranges, np.float32),
        "intensities": np.zeros(0, np.float32),
    }
    return cdr.LaserScan(**fields | more)


ROBOT = GROUND.in_real_time()
LIMITS = StepLimits.of(ROBOT)  # 0.25 m/s and 0.5 rad/s


def odometry(at, x=0.0, speed=0.0, heading=0.0, frame="odom", y=0.0, turn_rate=0.0):
    none = np.zeros(36)
    return cdr.Odometry(
        header=cdr.header(at, frame),
        child_frame_id="base_footprint",
        pose=cdr.PoseWithCovariance(pose=cdr.pose(x, y, heading), covariance=none),
        twist=cdr.TwistWithCovariance(twist=cdr.twist(speed, turn_rate), covariance=none),
    )


def transform(parent, child, x=0.0, y=0.0, rotation=None, at=0.0):
    moved = cdr.Transform(translation=cdr.vector(x, y), rotation=rotation or cdr.quaternion(0.0))
    return cdr.TransformStamped(header=cdr.header(at, parent), child_frame_id=child, transform=moved)


def test_states_are_interpolated_and_extrapolated_a_little():
    history = OdometryHistory(LIMITS)
    for i in range(11):
        history.add(0.1 * i, 0.02 * i, 0.0, 0.0, 0.2, 0.0)
    assert history.state(0.55) == pytest.approx([0.11, 0.0, 0.0, 0.2, 0.0])
    assert history.state(1.05) == pytest.approx([0.21, 0.0, 0.0, 0.2, 0.0])
    assert history.state(1.2) is None and history.state(-0.1) is None


def test_extrapolation_follows_the_arc_and_headings_pass_through_pi():
    history = OdometryHistory(LIMITS)
    history.add(0.0, 0.0, 0.0, 3.1, 0.2, 0.5)
    history.add(0.1, 0.0, 0.0, -3.13, 0.2, 0.5)
    assert history.state(0.05)[2] == pytest.approx(-3.1566 + 2.0 * math.pi, abs=1e-3)
    assert history.state(0.18)[2] == pytest.approx(-3.09, abs=1e-6)


def test_the_history_is_bounded_and_restarts_when_time_goes_back():
    history = OdometryHistory(LIMITS)
    for i in range(1000):
        history.add(0.01 * i, 0.0, 0.0, 0.0, 0.0, 0.0)
    assert len(history._rows) <= HISTORY / 0.01 + 2
    for at, x in ((9.5, 1.0), (math.nan, 1.0), (10.0, math.nan)):
        history.add(at, x, 0.0, 0.0, 0.0, 0.0)
    assert history.newest == pytest.approx(9.99) and history.state(9.5)[0] == 0.0
    history.add(1.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    assert history.newest == 1.0 and history.state(1.0) is not None and history.state(9.5) is None


def test_speeds_are_computed_from_poses_without_speeds():
    history = OdometryHistory(LIMITS)
    for i in range(50):
        angle = 0.4 * 0.02 * i
        history.add_pose(0.02 * i, 0.5 * math.sin(angle), 0.5 * (1.0 - math.cos(angle)), angle)
    assert history.state(0.9)[3:] == pytest.approx([0.2, 0.4], abs=1e-3)


def test_no_state_is_interpolated_in_a_long_gap():
    history = OdometryHistory(LIMITS, gap=0.15)
    for at in (0.0, 0.1, 1.1, 1.2):
        history.add(at, 0.2 * at, 0.0, 0.0, 0.2, 0.0)
    assert history.state(0.05) is not None and history.state(1.15) is not None
    assert history.state(0.6) is None and history.at(np.array([0.05, 0.6])) is None
    poses = OdometryHistory(LIMITS, gap=0.15)
    for at in (0.0, 0.05, 0.1, 0.15, 1.15, 1.2, 1.25, 1.3):
        poses.add_pose(at, 0.2 * at, 0.0, 0.0)
    assert poses.state(0.05) is None, "one pose gives no speed"
    assert poses.state(0.12)[3] == pytest.approx(0.2)
    assert poses.state(1.17) is None and poses.state(1.28)[3] == pytest.approx(0.2)


def test_transforms_are_composed_up_and_down_the_tree():
    frames = TransformTree()
    frames.add(transform("base_footprint", "base_link", 0.0, 0.1, cdr.quaternion(0.5 * math.pi)))
    frames.add(transform("/base_link", "base_scan", 0.2))
    forward = frames.pose("base_scan", "base_footprint")
    assert (forward.x, forward.y, forward.yaw) == pytest.approx((0.0, 0.3, 0.5 * math.pi))
    identity = frames.pose("base_footprint", "base_scan").compose(forward)
    assert (identity.x, identity.y, identity.yaw) == pytest.approx((0.0, 0.0, 0.0))
    assert frames.pose("camera", "base_footprint") is None


def tilted(degrees):
    """Return a rotation that is turned by 90° and then tilted."""
    half, level = 0.5 * math.radians(degrees), math.sqrt(0.5)
    x, y, z, w = (level * part for part in (math.sin(half), math.sin(half), math.cos(half), math.cos(half)))
    return cdr.Quaternion(x=x, y=y, z=z, w=w)


@pytest.mark.parametrize("degrees", [0.0, 2.9, 3.1, 17.0, 90.0, 180.0])
def test_a_scan_of_a_lidar_that_is_tilted_by_more_than_3_degrees_is_refused_by_name(degrees):
    """Up to 18 degrees once counted as level: at 1 m, such a beam ends 31 cm above or below the plane."""
    inputs = RosInputs(ROBOT, SensorSettings(), AgeLimits())
    inputs.on_odometry(odometry(10.0))
    inputs.on_scan(scan_of(np.full(BEAMS, math.inf)))
    inputs.on_fixed_transforms(
        cdr.TFMessage(transforms=[transform("base_footprint", "base_scan", rotation=tilted(degrees))])
    )
    if degrees < 3.0:
        assert inputs.obstacles(np.zeros(2), 10.0) == ()
        return
    named = rf"'base_scan' is tilted by {degrees:.1f}° against 'base_footprint': .* at most 3°"
    with pytest.raises(InputMissing, match=named):
        inputs.obstacles(np.zeros(2), 10.0)


def test_the_tilts_of_a_chain_of_frames_add_up():
    frames = TransformTree()
    frames.add(transform("base", "plate", rotation=tilted(2.0)))
    frames.add(transform("plate", "scan", rotation=tilted(2.0)))
    assert frames.pose("scan", "base").tilt == pytest.approx(math.radians(4.0)) and math.radians(4.0) > MOST_TILT


def test_a_loop_of_frames_has_no_pose():
    frames = TransformTree()
    frames.add(transform("a", "b"))
    frames.add(transform("b", "a"))
    assert frames.pose("a", "base") is None


@pytest.mark.parametrize(("x", "heading"), [(0.5, 0.0), (0.0, 1.0), (0.0, -math.pi)])
@pytest.mark.parametrize("transforms", [False, True])
def test_a_step_that_the_robot_cannot_do_is_said_once_and_begins_a_new_history(x, heading, transforms):
    """As after a localisation that was set anew. The scan from before is in another frame then."""
    settings = SensorSettings(mount=PlanarPose(), base_frame="base_footprint" if transforms else "")
    inputs = RosInputs(ROBOT, settings, AgeLimits())

    def drive(first, last, x, heading):
        for i in range(first, last):
            at, ahead = 9.0 + 0.02 * i, x + 0.004 * i
            if transforms:
                moved = transform("odom", "base_footprint", ahead, rotation=cdr.quaternion(heading), at=at)
                inputs.on_transforms(cdr.TFMessage(transforms=[moved]))
            else:
                inputs.on_odometry(odometry(at, ahead, 0.2, heading))

    drive(0, 51, 0.0, 0.0)
    inputs.on_scan(scan_of(np.full(BEAMS, math.inf)))
    assert inputs.state(9.9, 10.0) is not None and inputs.obstacles(np.zeros(2), 10.0) == ()
    drive(51, 61, x, heading)
    with pytest.raises(PoseJumped, match=r"the pose jumped by 0\.[05]0 m and [013]\.\d\d rad within 0\.02 s"):
        inputs.state(10.15, 10.2)
    with pytest.raises(InputMissing, match="no odometry of when the scan was made"):
        inputs.obstacles(np.zeros(2), 10.2)
    drive(61, 80, x, heading)
    if heading == 0.0:
        assert inputs.state(10.5, 10.58) == pytest.approx([x + 0.3, 0.0, 0.0, 0.2, 0.0], abs=1e-6)
    inputs.on_scan(scan_of(np.full(BEAMS, math.inf), header=cdr.header(10.5, "base_scan")))
    assert inputs.obstacles(np.zeros(2), 10.58) == ()


def test_what_a_robot_can_do_is_no_jump():
    """Neither are a gap, a late stamp, and errors of the measurement."""
    history = OdometryHistory(LIMITS)
    for time, x, heading in ((0.0, 0.0, 3.1), (0.02, 0.02, -3.12), (0.021, 0.005, 3.1), (4.0, 0.4, 2.5)):
        history.add(time, x, 0.0, heading, 0.2, 0.0)
        assert history.newest == time and history.jump == ""
    history.add(1.0, 0.4, 0.0, 2.5, 0.2, 0.0)
    assert history.newest == 1.0 and history.jump == "the time of the odometry went back by 3.00 s"


@pytest.mark.parametrize("gap", [2.0, 60.0])
@pytest.mark.parametrize(("x", "heading"), [(0.8, 0.0), (0.0, 1.5)])
def test_a_robot_brakes_in_a_gap_so_a_pose_that_is_far_away_after_it_is_a_jump(gap, x, heading):
    """As after a restart of what sends the odometry. Space stated as free before stayed free, elsewhere."""
    inputs = RosInputs(ROBOT, SensorSettings(mount=PlanarPose(), free_at_start=0.5), AgeLimits())
    for i in range(3):
        inputs.on_odometry(odometry(9.9 + 0.05 * i, 0.01 * i, 0.2))
    inputs.on_odometry(odometry(10.0 + gap, x, 0.0, heading))
    with pytest.raises(PoseJumped, match=rf"the pose jumped by .* within {gap:.2f} s"):
        inputs.state(10.0 + gap, 10.0 + gap)


@pytest.mark.parametrize("gap", [0.5, 60.0])
@pytest.mark.parametrize(("stood", "x", "heading", "jumps"), [
    (True, 0.1, 0.0, True), (True, 0.05, 0.05, False), (True, 0.0, 0.1, True),
    (False, 0.5, 0.0, True), (False, 0.2, 0.3, False),
])  # fmt: skip
def test_in_a_gap_a_robot_moves_no_farther_than_its_inputs(gap, stood, x, heading, jumps):
    """Before, a robot that stood could find itself 63 cm away after its odometry had begun anew."""
    inputs = RosInputs(ROBOT, SensorSettings(mount=PlanarPose()), AgeLimits())
    speed = np.array([0.0, 0.0] if stood else [0.25, 0.5])
    inputs.executed(speed, 8.0)
    for i in range(3):
        inputs.on_odometry(odometry(9.9 + 0.05 * i))
    inputs.executed(0.5 * speed, 10.3)
    inputs.executed(np.zeros(2), 10.45)
    inputs.on_odometry(odometry(10.0 + gap, x, 0.0, heading))
    inputs.on_odometry(odometry(10.05 + gap, x, 0.0, heading))
    with pytest.raises(PoseJumped, match="can't have done") if jumps else nullcontext():
        inputs.state(10.05 + gap, 10.05 + gap)


@pytest.mark.parametrize("transforms", [False, True])
def test_odometry_of_a_robot_that_leans_does_not_count_until_it_stands_upright(transforms):
    """As on its side, or from a driver that counts its angles otherwise."""
    settings = SensorSettings(mount=PlanarPose(), base_frame="base_footprint" if transforms else "")
    inputs = RosInputs(ROBOT, settings, AgeLimits())

    def measure(at, lean):
        turn = cdr.Quaternion(x=math.sin(0.5 * lean), y=0.0, z=0.0, w=math.cos(0.5 * lean))
        message = odometry(at)
        message.pose.pose.orientation = turn
        moved = cdr.TFMessage(transforms=[transform("odom", "base_footprint", rotation=turn, at=at)])
        inputs.on_transforms(moved) if transforms else inputs.on_odometry(message)

    for k in range(8):
        measure(9.8 + 0.02 * k, 0.3)
    assert inputs.state(9.93, 9.95) is not None, "a ramp"
    for lean in (0.35, 1.57, -math.pi):
        measure(9.96, lean)
        with pytest.raises(
            InputMissing, match=rf"leans by {abs(math.degrees(lean)):.0f}° against 'odom': .* at most 18°"
        ):
            inputs.state(9.95, 9.97)
    measure(9.96, 0.0)
    assert inputs.state(9.95, 9.97) is not None


def test_odometry_in_another_frame_is_refused_and_both_are_named():
    inputs = RosInputs(ROBOT, SensorSettings(mount=PlanarPose(), odometry_frame="/odom"), AgeLimits())
    for frame in ("map", ""):
        inputs.on_odometry(odometry(10.0, frame="odom"))
        assert inputs.state(10.0, 10.0) is not None
        inputs.on_odometry(odometry(10.01, frame=frame))
        with pytest.raises(InputMissing, match=rf"in frame '{frame}', not in '/odom' \(see --odometry-frame\)"):
            inputs.state(10.0, 10.02)
        inputs.on_odometry(odometry(10.02, frame="odom"))
        assert inputs.state(10.0, 10.02) is not None and inputs.frame == "/odom"


@pytest.fixture
def inputs():
    """Return inputs with odometry, a scan and a command of t = 10 s."""
    inputs = RosInputs(ROBOT, SensorSettings(mount=PlanarPose()), AgeLimits())
    for i in range(101):
        inputs.on_odometry(odometry(9.0 + 0.01 * i, x=0.001 * i))
    inputs.on_scan(scan_of(np.full(BEAMS, math.inf)))
    inputs.on_command(cdr.twist(0.2, 0.1), 10.0)
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


def test_the_oldest_beam_of_a_scan_counts_as_its_age(inputs):
    """Some drivers state the end of a turn as its time, and a negative time between two beams."""
    for turn, refused in ((0.5, False), (0.8, True)):
        inputs.on_scan(scan_of(np.full(BEAMS, math.inf), time_increment=-turn / BEAMS))
        if refused:
            with pytest.raises(InputMissing, match=r"the scan is 0\.85 s old"):
                inputs.obstacles(np.zeros(2), 10.05)
        else:
            assert inputs.obstacles(np.zeros(2), 10.05) == ()


def test_a_command_counts_until_its_age_limit(inputs):
    assert inputs.command(10.6) is None
    inputs.on_command(cdr.twist(math.nan, 0.0), 10.6)
    assert not np.isfinite(inputs.command(10.6).action).all(), "the filter has to handle it"
    inputs.on_command(cdr.TwistStamped(header=cdr.header(0.0, ""), twist=cdr.twist(0.1, 0.0)), 10.7)
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
    bare.on_fixed_transforms(cdr.TFMessage(transforms=[transform("base_footprint", "base_scan", -0.03)]))
    assert bare.obstacles(np.zeros(2), 10.1)
    bare.on_scan(scan_of(np.full(BEAMS, 1.0), angle_increment=0.0))
    with pytest.raises(InputMissing, match="no valid scan"):
        bare.obstacles(np.zeros(2), 10.1)


def test_a_scan_that_does_not_show_all_directions_counts_as_missing(inputs):
    """The robot then brakes. Obstacles in their places once led it away from them, at 0.075 m/s and without end."""
    fan = {"angle_min": -0.75 * math.pi, "angle_increment": math.pi / 180}
    for scan, unknown in ((scan_of(np.full(270, math.inf), **fan), 90), (scan_of(np.full(BEAMS, math.nan)), BEAMS)):
        inputs.on_scan(scan)
        with pytest.raises(InputMissing, match=f"no valid scan: it has no information in {unknown} of 360 directions"):
            inputs.obstacles(np.zeros(2), 10.05)
    inputs.on_scan(scan_of(np.full(BEAMS, math.inf)))
    assert inputs.obstacles(np.zeros(2), 10.05) == ()


def test_without_a_child_frame_the_lidar_has_no_place():
    """A lidar that looks backwards would show a wall ahead as one behind if its place counted as the robot's centre."""
    bare = RosInputs(ROBOT, SensorSettings(), AgeLimits())
    bare.on_fixed_transforms(cdr.TFMessage(transforms=[transform("base_footprint", "base_scan", -0.03)]))
    bare.on_scan(scan_of(np.full(BEAMS, 1.0)))
    message = odometry(10.0)
    message.child_frame_id = ""
    bare.on_odometry(message)
    with pytest.raises(InputMissing, match="names no child frame: give the lidar's place"):
        bare.obstacles(np.zeros(2), 10.1)


@pytest.mark.parametrize("stated", [True, False])
@pytest.mark.parametrize(("x", "accepted"), [(-0.032, True), (0.9, True), (-32.0, False), (3.2, False)])
def test_a_lidar_whose_place_is_in_mm_or_cm_is_refused(stated, x, accepted):
    """All obstacles were metres away, so a wall before the robot was free space."""
    inputs = RosInputs(ROBOT, SensorSettings(mount=PlanarPose(x) if stated else None), AgeLimits())
    inputs.on_fixed_transforms(cdr.TFMessage(transforms=[transform("base_footprint", "base_scan", x)]))
    inputs.on_odometry(odometry(10.0))
    inputs.on_scan(scan_of(np.full(BEAMS, 0.3)))
    if accepted:
        assert inputs.obstacles(np.zeros(2), 10.0)
        return
    with pytest.raises(InputMissing, match=r"the lidar is 3.* m from the origin of 'base_footprint'.* place in m"):
        inputs.obstacles(np.zeros(2), 10.0)


def test_a_yaw_of_the_lidar_in_degrees_is_refused():
    for yaw in (math.pi, -1.5 * math.pi):
        assert SensorSettings(mount=PlanarPose(0.0, 0.0, yaw)).mount is not None
    with pytest.raises(ValueError, match="yaw is 180 rad, more than a turn: give it in radians"):
        SensorSettings(mount=PlanarPose(0.0, 0.0, 180.0))


def test_an_age_limit_that_is_no_number_accepts_nothing():
    limits = AgeLimits(odometry=math.nan, scan=math.nan, command=math.nan)
    inputs = RosInputs(ROBOT, SensorSettings(mount=PlanarPose()), limits)
    inputs.on_odometry(odometry(10.0))
    inputs.on_scan(scan_of(np.full(BEAMS, math.inf)))
    inputs.on_command(cdr.twist(0.2, 0.1), 10.0)
    assert inputs.command(10.0) is None
    for ask in (lambda: inputs.state(10.0, 10.0), lambda: inputs.obstacles(np.zeros(2), 10.0)):
        with pytest.raises(InputMissing):
            ask()


def test_transforms_can_replace_odometry():
    inputs = RosInputs(ROBOT, SensorSettings(base_frame="base"), AgeLimits())
    for i in range(30):
        inputs.on_transforms(
            cdr.TFMessage(
                transforms=[
                    transform("map", "odom", 5.0, at=0.02 * i),
                    transform("odom", "base", 0.004 * i, at=0.02 * i),
                ]
            )
        )
    assert inputs.state(0.5, 0.58) == pytest.approx([0.1, 0.0, 0.0, 0.2, 0.0], abs=1e-6)


def test_a_clock_that_was_set_reports_the_jump_once():
    simulated = RosSimulatedClock()
    for stamp in (100.0, 99.9, 101.0):
        simulated.on_clock(cdr.Clock(clock=cdr.time_of(stamp)))
    assert simulated.now() == 101.0 and simulated.jumped() == 0.0
    simulated.on_clock(cdr.Clock(clock=cdr.time_of(5.0)))
    assert simulated.now() == 5.0 and simulated.jumped() == pytest.approx(-96.0) and simulated.jumped() == 0.0
    clock = SystemClock()
    before = clock.now()
    real = clock._offset
    clock._offset = real - 7.0
    assert clock.jumped() == pytest.approx(7.0, abs=0.04) and clock.now() >= before

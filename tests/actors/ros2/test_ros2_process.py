"""The filter process among ROS 2 nodes that fall silent: a missing input stops the robot until it comes again."""

import math
import threading
import time
from contextlib import contextmanager
from itertools import pairwise

import numpy as np
import pytest

from brakeline.actors.ros2.command_gate import BLIND, LATE, NO_ANSWER
from brakeline.actors.ros2.ros2_process import FilterNode, Ros2Settings, driven
from brakeline.actors.ros2.ros2_settings import AgeLimits, SensorSettings
from brakeline.actors.ros2.ros_inputs import RawCommand
from brakeline.actors.ros2.ros_views import diagnostics, markers
from brakeline.actors.ros2.sensor_frames import PlanarPose
from brakeline.errors import BadRequest, Mismatch
from brakeline.messaging import brakeline_pb2 as pb
from brakeline.messaging.free_ports import free_endpoint
from brakeline.messaging.obstacle import Obstacle
from brakeline.messaging.ros2 import LATCHED, SENSOR, RosNode, RosSettings
from brakeline.messaging.ros2 import cdr_messages as cdr
from brakeline.safety.filter.backup_plan import UNVERIFIED
from brakeline.safety.service.wire import decision_of
from tests.actors.ros2.test_command_gate import allow
from tests.actors.ros2.test_ros_inputs import BEAMS, odometry, scan_of, transform
from tests.robots import GROUND
from tests.waiting import until

ROBOT = GROUND.in_real_time()
STATE = np.zeros(ROBOT.state_dim)


def test_a_robot_that_a_twist_cannot_drive_is_refused():
    assert driven("ground") == driven("ground-late") == ROBOT
    with pytest.raises(Mismatch, match="quadrotor"):
        driven("quadrotor")
    assert Ros2Settings().lead < ROBOT.period


def test_markers_and_diagnostics_survive_encoding():
    request = pb.Request(action=[0.2, 0.0], input_in_force=[0.0, 0.0], plan=[0.0] * 2 * ROBOT.horizon)
    decision = allow([request])[0].decision
    obstacles = (Obstacle("box", (1.0, 0.0), (0.1, 0.5), 0.3), Obstacle("cylinder", (0.0, 1.0), (0.1,)))
    shown = cdr.decode(cdr.MarkerArray, cdr.encode(markers(3.0, "odom", decision_of(decision, ROBOT), obstacles)))
    groups = [marker.ns for marker in shown.markers]
    assert groups.count("tube") == ROBOT.horizon and groups.count("plan") == 1 and groups.count("obstacles") == 2
    assert {marker.header.frame_id for marker in shown.markers} == {"odom"}
    for kind, level in (("allowed", 0), ("adjusted", 1), ("failsafe", 1), (BLIND, 2), (LATE, 2), (NO_ANSWER, 2)):
        sent = diagnostics(3.0, "brakeline", "ground", kind, "why", {"periods": 3.0})
        message = cdr.decode(cdr.DiagnosticArray, cdr.encode(sent))
        (status,) = message.status
        assert (status.level, status.message, status.values[0].key) == (level, f"{kind}: why", "periods")
    assert cdr.DiagnosticStatus.ERROR == 2


# Wide, for a busy machine: only the absence of a message shows that its sender is silent.
AGE_LIMITS = AgeLimits(odometry=1.0, scan=1.5, command=1.0)


class Robot:
    """The nodes of a robot, which publish all inputs 20 times a second except those in `mute`."""

    def __init__(self, node, simulated, stamped):
        self.mute, self.speeds, self.simulated = set(), [], simulated
        self.reasons = []
        self._odometry, self._scan = node.publisher("odom", cdr.Odometry), node.publisher("scan", cdr.LaserScan, SENSOR)
        self._clock = node.publisher("/clock", cdr.Clock, SENSOR)
        kind = cdr.TwistStamped if stamped else cdr.Twist
        self._raw, self._stamped = node.publisher("cmd_vel_raw", kind), stamped
        node.publisher("/tf_static", cdr.TFMessage, LATCHED).put(
            cdr.TFMessage(transforms=[transform("base_footprint", "base_scan")])
        )
        node.subscribe("cmd_vel", kind, lambda m: self.speeds.append(m.twist.linear.x if stamped else m.linear.x))
        node.subscribe("/diagnostics", cdr.DiagnosticArray, lambda m: self.reasons.append(m.status[0].message))
        self.offset = 0.0
        self._time = 100.0
        self._done = threading.Event()
        self._thread = threading.Thread(target=self._run)
        self._thread.start()

    def now(self):
        return (self._time if self.simulated else time.time()) + self.offset

    def close(self):
        self._done.set()
        self._thread.join()

    def drives(self):
        """Check that a command is executed from now on."""
        del self.speeds[:]
        until(lambda: self.speeds and self.speeds[-1] == 0.2, lambda: f"driving again: {self.reasons[-3:]}", 30.0)

    def stops(self, because):
        until(lambda: self.speeds and self.speeds[-1] == 0.0, f"a stop: {because}", 30.0)
        until(
            lambda: any(because in reason for reason in self.reasons),
            lambda: f"{because}, not {self.reasons[-3:]}",
            30.0,
        )
        del self.speeds[:]
        until(lambda: len(self.speeds) > 2, "more commands", 30.0)
        assert set(self.speeds) == {0.0}
        del self.reasons[:]

    def _run(self):
        while not self._done.wait(0.05):
            if self.simulated and "clock" not in self.mute:
                self._time += 0.05
                self._clock.put(cdr.Clock(clock=cdr.time_of(self._time)))
            now = self.now()
            if "odometry" not in self.mute:
                self._odometry.put(odometry(now, speed=0.2))
            if "scan" not in self.mute:
                self._scan.put(scan_of(np.full(BEAMS, math.inf), header=cdr.header(now, "base_scan")))
            if "command" not in self.mute:
                raw = cdr.twist(math.nan if "numbers" in self.mute else 0.2, 0.0)
                self._raw.put(cdr.TwistStamped(header=cdr.header(now, ""), twist=raw) if self._stamped else raw)


@contextmanager
def steered(simulated=False, stamped=False, sends_stamped=None):
    endpoint, stop = free_endpoint(), threading.Event()
    with RosNode(RosSettings(listen=(endpoint,), namespace="/r"), "robot") as node:
        robot = Robot(node, simulated, stamped if sends_stamped is None else sends_stamped)
        settings = Ros2Settings(
            ros=RosSettings(connect=(endpoint,), namespace="/r"),
            sim_time=simulated,
            stamped=stamped,
            sensors=SensorSettings(),
            age_limits=AGE_LIMITS,
        )
        node_under_test = FilterNode(settings, allow, stop)
        thread = threading.Thread(target=node_under_test.run)
        thread.start()
        try:
            yield robot, node_under_test
        finally:
            stop.set()
            thread.join(20.0)
            node_under_test.close()
            robot.close()
            assert not thread.is_alive()


class Stalling:
    """A clock that waits exactly, and once `stall` seconds longer."""

    def __init__(self):
        self.time, self.stall = 100.0, 0.0

    def now(self):
        return self.time

    def wait(self, moment, stop, patience):
        self.time, self.stall = max(self.time, moment) + self.stall, 0.0
        return True

    def jumped(self):
        return 0.0


@contextmanager
def stepped(**settings):
    """Begin no thread: yield a node, its clock, a call that runs one period of it, and the requests that it sends."""
    stop, requests = threading.Event(), []

    def ask(asked):
        requests.extend(asked)
        return allow(asked)

    node = FilterNode(Ros2Settings(ros=RosSettings(listen=(free_endpoint(),)), **settings), ask, stop)
    node.clock = Stalling()
    try:
        yield node, node.clock, lambda due: node._period(due, stop), requests
    finally:
        node.close()


def test_a_missing_input_stops_the_robot_until_it_comes_again_and_the_end_of_the_process_does():
    with steered() as (robot, node_under_test):
        for what, because in (
            ("odometry", "odometry is"),
            ("scan", "the scan is"),
            ("command", "no command"),
            ("numbers", "holds NaN"),
        ):
            robot.drives()
            robot.mute.add(what)
            robot.stops(because)
            robot.mute.clear()
        robot.drives()
    assert robot.speeds[-1] == 0.0 and not node_under_test.gate.backup_plan.plan.any()
    assert node_under_test.gate.stats.kinds["allowed"] > 0


def test_a_node_that_commands_the_base_past_the_filter_stops_the_robot_until_it_is_gone():
    with steered() as (robot, node_under_test):
        robot.drives()
        with RosNode(node_under_test.node.settings, "teleop") as other:
            other.publisher("cmd_vel", cdr.TwistStamped)  # whatever its type is
            robot.stops("/r/teleop publishes on cmd_vel too, past the filter: let it publish on cmd_vel_raw")
        robot.drives()


def test_commands_of_another_type_are_named():
    with steered(stamped=True, sends_stamped=False) as (robot, _):
        expected = "/robot sends cmd_vel_raw as another type than we expect: leave out --stamped"
        until(lambda: any(expected in reason for reason in robot.reasons), lambda: f"{robot.reasons[-3:]}", 30.0)


@pytest.mark.parametrize("settings", [{"lead": math.nan}, {"lead": 0.0}, {"seconds": math.nan}])
def test_settings_that_are_no_times_are_refused(settings):
    with pytest.raises(ValueError, match=next(iter(settings))):
        Ros2Settings(**settings)


def test_an_error_in_a_decision_brakes_the_robot_and_the_process_goes_on():
    """Such as an obstacle at 1e200 m, or more obstacles than a request may hold."""
    with steered() as (robot, node_under_test):
        robot.drives()
        ask = node_under_test.gate._ask

        def refuse(requests):
            raise BadRequest("obstacles", "1321 obstacles; at most 1000")

        node_under_test.gate._ask = refuse
        robot.stops("at most 1000")
        node_under_test.gate._ask = ask
        robot.drives()


def test_a_clock_that_stands_still_or_goes_back_stops_the_robot():
    with steered(simulated=True) as (robot, _):
        robot.drives()
        robot.mute.add("clock")
        robot.stops("the clock stands still")
        robot.mute.clear()
        robot.drives()
        robot._time = 3.0
        until(lambda: any("the clock was set" in reason for reason in robot.reasons), "the clock was set", 30.0)
        robot.drives()


def test_after_a_jump_of_the_pose_the_plan_from_before_does_not_count_as_verified():
    """The robot brakes along it all the same, says why, and goes on."""
    with stepped(sensors=SensorSettings(mount=PlanarPose())) as (node, clock, period, requests):
        gate, inputs = node.gate, node.inputs

        def drive(x):
            for i in range(1, 12):
                at = clock.time + 0.02 * i
                inputs.on_odometry(odometry(at, x, 0.0))
            inputs.on_scan(scan_of(np.full(BEAMS, math.inf), header=cdr.header(clock.time + 0.15, "base_scan")))
            inputs.on_command(cdr.twist(0.2, 0.0), clock.time + 0.15)

        due, kinds = 100.2, []
        for x in (0.0, 0.0, 0.0, 2.0, 2.0, 2.0):
            drive(x)
            due = period(due)
            kinds.append((gate.kind, gate.reason))
        assert "the pose jumped by 2.00 m" in kinds[4][1] and kinds[4][0] == BLIND
        models = [request.model for request in requests]
        assert models[2] == "m" and models[3] == UNVERIFIED and not requests[3].plan_token
        assert gate.kind == "allowed"


def test_a_robot_that_stood_is_not_elsewhere_after_a_gap_of_the_odometry():
    with stepped(sensors=SensorSettings(mount=PlanarPose())) as (node, clock, period, _):
        due, reasons = 100.2, []
        for x in (0.0, 0.0, 0.0, None, None, 0.2, 0.2):
            for i in range(1, 12) if x is not None else ():
                node.inputs.on_odometry(odometry(clock.time + 0.02 * i, x, 0.0))
            due = period(due)
            reasons.append(node.gate.reason)
        assert "the pose jumped by 0.20 m" in reasons[6], reasons


def test_an_answer_for_a_past_period_does_not_count():
    with stepped() as (node, clock, period, _):
        gate = node.gate
        full = lambda number: RawCommand(np.array([0.25, 0.0]), clock.time, number)  # noqa: E731
        node._decide = lambda began, number: gate.decide(np.zeros(5), (), full(number), began, number)
        due = 100.0
        for _ in range(3):
            due = period(due)
        assert gate.kind == "allowed" and gate.input[0] == 0.25
        clock.stall = 1.5
        due = period(due)
        assert gate.kind == LATE and gate.stats.slips == 1 and due > clock.now()
        assert gate.input[0] < 0.25, "it brakes"


@pytest.mark.parametrize("share", [0.3, 0.9, 1.1, 2.5])
def test_no_decision_rests_on_an_input_that_the_base_executed_for_part_of_a_period(share):
    """A period begins late by a share of its length: the base went on with the input before."""
    sent = []
    with stepped() as (node, clock, period, requests):
        gate = node.gate
        command = lambda number: RawCommand(np.array([0.05 + 0.1 * (number % 2), 0.0]), clock.time, number)  # noqa: E731
        node._decide = lambda began, number: gate.decide(np.zeros(5), (), command(number), began, number)
        node._send = lambda action: sent.append((clock.now(), action[0]))
        due, before = 100.0, 0
        for number in range(12):
            if number == 5:
                clock.stall, before = share * ROBOT.period, len(requests)
            due = period(due)
            assert number != 5 or gate.kind == LATE
        sent.append((due, 0.0))
        assert requests[before].model != "m" and requests[-1].model == "m"
        for request in requests:
            end = request.time + ROBOT.period
            for (since, value), (until_, _) in pairwise(sent):
                if value != request.plan[0]:
                    assert min(until_, end) - max(since, request.time) < 0.02 + 1e-9, request.time


def test_clocks_that_differ_stop_the_robot():
    with steered(stamped=True) as (robot, _):
        robot.drives()
        robot.offset = -20.0
        robot.stops("odometry is")
        robot.offset = 20.0
        robot.stops("in the future")

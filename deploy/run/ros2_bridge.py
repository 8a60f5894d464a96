"""Simulate a ground robot as a ROS 2 robot: odometry, scan, transforms and clock out, cmd_vel in.

As usual for ROS bases, the robot follows the last command, and stops if none arrives for `timeout` s. The time is this
machine's, or simulated time on /clock, which runs at most `factor` times as fast as real time. With `lockstep` each
control period waits for its command, so that no command is late on a busy machine.
"""

from __future__ import annotations

import threading
import time
from dataclasses import dataclass, field

import numpy as np

from brakeline.messaging.robot import Array
from brakeline.messaging.ros2 import LATCHED, SENSOR, MessageTap, RosNode, RosSettings
from brakeline.messaging.ros2.cdr_messages import (
    Clock,
    LaserScan,
    Odometry,
    PoseWithCovariance,
    TFMessage,
    Transform,
    TransformStamped,
    Twist,
    TwistStamped,
    TwistWithCovariance,
    header,
    pose,
    quaternion,
    time_of,
    twist,
    vector,
)
from brakeline.messaging.task import robot_with_task
from brakeline.sim.arena_generator import draw_arena
from brakeline.sim.ground_realtime import RealtimeGroundRobot, SpinningLidar
from brakeline.sim.ground_robot import SAMPLE_TIME, SAMPLES, changes_of
from brakeline.sim.sim_conditions import Conditions

ODOM, BASE, LASER = "odom", "base_footprint", "base_scan"
LARGEST_LAG = 0.2  # s behind real time, beyond which the simulation gives up catching up


@dataclass(frozen=True)
class BridgeSettings:
    """Settings of the simulated robot and its node."""

    ros: RosSettings = field(default_factory=lambda: RosSettings(listen=("tcp/127.0.0.1:7447",)))
    arena: str = "default"
    seed: int = 0
    sim_time: bool = False  # publish simulated time on /clock
    factor: float = 1.0  # highest multiple of real time; 0: as fast as possible
    lockstep: bool = False  # each period waits for its command
    patience: float = 1.0  # s of real time, longest wait of a period
    timeout: float = 0.3  # s without a command after which the base stops
    stamped: bool = False  # commands are TwistStamped
    seconds: float = 0.0  # duration; 0: until the stop event
    conditions: Conditions = field(default_factory=Conditions)  # the robot always scans, and no scan is late

    def __post_init__(self) -> None:
        if self.conditions.perception.faults.late:
            raise ValueError("a simulated ROS 2 robot has no late scans: leave out --late")


@dataclass
class Outcome:
    """Figures of the simulation so far."""

    seconds: float = 0.0
    collisions: int = 0
    closest: float = float("inf")  # m from the body's disc to an obstacle
    driven: float = 0.0  # m
    commands: int = 0
    timeouts: int = 0  # stops because no command arrived
    missed: int = 0  # periods of lockstep without a command
    slips: int = 0  # times that the simulation gave up catching up with real time


class Bridge:
    """One robot in one arena, as a ROS node."""

    def __init__(self, settings: BridgeSettings, tap: MessageTap | None = None) -> None:
        """Raises Unreachable, UnknownName.

        tap: records each received and sent message.
        """
        self.settings, self.outcome = settings, Outcome()
        rng = np.random.default_rng((settings.seed, 11))
        arena = draw_arena(settings.arena, np.random.default_rng(settings.seed), robot_with_task("ground"))
        c = settings.conditions
        self.robot = RealtimeGroundRobot(arena, rng, c.noise, process_noise=c.process_noise, **changes_of(c))
        self._lidar = SpinningLidar(arena, rng, c.lidar_noise(flies=False), faults=c.perception.faults)
        self._start_time = 1.0 if settings.sim_time else time.time()  # s, the robot's time at the first sample
        self._samples = 0
        self._received = threading.Condition()
        self._command: Array | None = None
        self._command_time = -np.inf  # s, the robot's time of the last command
        self._stopped = True
        self.node = RosNode(settings.ros, "brakeline_sim", tap)
        self._clock = self.node.publisher("/clock", Clock, SENSOR) if settings.sim_time else None
        self._odometry = self.node.publisher("odom", Odometry)
        self._transforms = self.node.publisher("/tf", TFMessage)
        self._scans = self.node.publisher("scan", LaserScan, SENSOR)
        fixed = self.node.publisher("/tf_static", TFMessage, LATCHED)
        fixed.put(TFMessage(transforms=[_transform(self._start_time, BASE, LASER, self._lidar.mount, 0.0, 0.0)]))
        if settings.stamped:
            self.node.subscribe("cmd_vel", TwistStamped, lambda message: self._receive(message.twist))
        else:
            self.node.subscribe("cmd_vel", Twist, self._receive)

    @property
    def now(self) -> float:
        """The robot's time [s]."""
        return self._start_time + self._samples * SAMPLE_TIME

    def run(self, stop: threading.Event) -> None:
        """Simulate until `stop` is set, or the duration ends."""
        settings = self.settings
        if not settings.sim_time:
            self._start_time = time.time() - self._samples * SAMPLE_TIME
        anchor, since = time.monotonic(), self.now
        while not stop.is_set() and not 0.0 < settings.seconds <= self.outcome.seconds:
            self._sample()
            if settings.lockstep and self._samples % SAMPLES == 0:
                self._await_command(stop)
            if settings.factor > 0.0:
                ahead = (self.now - since) / settings.factor - (time.monotonic() - anchor)
                if ahead > 0.0:
                    stop.wait(ahead)
                elif ahead < -LARGEST_LAG:
                    self.outcome.slips += not settings.lockstep
                    anchor, since = time.monotonic(), self.now
                    if not settings.sim_time:
                        self._start_time = time.time() - self._samples * SAMPLE_TIME
                        since = self.now

    def close(self) -> None:
        """Leave the ROS graph."""
        self.node.close()

    def _sample(self) -> None:
        """Simulate one sample: drive, sense, publish."""
        robot = self.robot
        with self._received:
            command, self._command = self._command, None
        if command is not None:
            robot.set_input(command)
            self._command_time, self._stopped = self.now, False
        elif not self._stopped and self.now - self._command_time > self.settings.timeout:
            robot.set_input(np.zeros(2))
            self._stopped = True
            self.outcome.timeouts += 1
        robot.advance()
        self._samples += 1
        self._publish()
        self.outcome.seconds = self._samples * SAMPLE_TIME
        self.outcome.collisions, self.outcome.closest = robot.collisions, robot.closest
        self.outcome.driven = robot.distance_driven

    def _publish(self) -> None:
        now, (x, y, yaw, speed, turn_rate) = self.now, self.robot.measured.tolist()
        unknown = np.zeros(36)
        self._odometry.put(
            Odometry(
                header=header(now, ODOM),
                child_frame_id=BASE,
                pose=PoseWithCovariance(pose=pose(x, y, yaw), covariance=unknown),
                twist=TwistWithCovariance(twist=twist(speed, turn_rate), covariance=unknown),
            )
        )
        self._transforms.put(TFMessage(transforms=[_transform(now, ODOM, BASE, x, y, yaw)]))
        ranges = self._lidar.measure_sector(self.robot.true)
        if ranges is not None:
            self._scans.put(self._scan(ranges))
        if self._clock is not None:
            self._clock.put(Clock(clock=time_of(now)))

    def _scan(self, ranges: Array) -> LaserScan:
        """Return the message of a scan.

        The message spaces the beams evenly in time. Each was cast at the end of a sample, at most half a sample off.
        """
        lidar, turn = self._lidar, SAMPLES * SAMPLE_TIME
        return LaserScan(
            header=header(self.now - turn + 0.5 * SAMPLE_TIME, LASER),
            angle_min=0.0,
            angle_max=lidar.gap * (len(ranges) - 1),
            angle_increment=lidar.gap,
            time_increment=turn / len(ranges),
            scan_time=turn,
            range_min=lidar.nearest,
            range_max=lidar.farthest,
            ranges=ranges.astype(np.float32),
            intensities=np.zeros(0, dtype=np.float32),
        )

    def _receive(self, message: Twist) -> None:
        action = np.array([message.linear.x, message.angular.z])
        if np.isfinite(action).all():
            with self._received:
                self._command = action
                self.outcome.commands += 1
                self._received.notify_all()

    def _await_command(self, stop: threading.Event) -> None:
        with self._received:
            received = self._received.wait_for(
                lambda: self._command is not None or stop.is_set(), self.settings.patience
            )
        self.outcome.missed += not received


def _transform(at: float, parent: str, child: str, x: float, y: float, yaw: float) -> TransformStamped:
    transform = Transform(translation=vector(x, y), rotation=quaternion(yaw))
    return TransformStamped(header=header(at, parent), child_frame_id=child, transform=transform)

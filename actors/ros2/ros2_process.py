"""PROCESS: a ROS 2 robot behind the filter: its raw commands in, what may be driven out.

Periods follow each other by the robot's clock. In each: its input goes out, and again every `RESEND` s; `lead` before
its end the newest raw command is asked about; at its end the answer's input follows, or the committed plan's if there
is none. What is missing or stale is a reason to brake along that plan. If the process dies, the base's own timeout
brakes.
"""

from __future__ import annotations

import logging
import math
import threading
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from brakeline.actors.decision_guard import Ask
from brakeline.actors.ros2.command_gate import CommandGate
from brakeline.actors.ros2.ros_clock import RosClock, SimulatedClock, SystemClock
from brakeline.actors.ros2.ros_inputs import AgeLimits, InputMissing, RosInputs, SensorSettings
from brakeline.actors.ros2.ros_views import diagnostics, markers
from brakeline.messaging.obstacle import Obstacle
from brakeline.messaging.robot import Robot
from brakeline.messaging.ros2 import LATCHED, SENSOR, MessageTap, RosNode, RosPublisher, RosSettings
from brakeline.messaging.ros2.cdr_messages import (
    Clock,
    DiagnosticArray,
    LaserScan,
    MarkerArray,
    Odometry,
    TFMessage,
    Twist,
    TwistStamped,
    header,
    twist,
)
from brakeline.messaging.task import robot_maybe_with_task
from brakeline.safety.service.wire import KINDS

Array = NDArray[np.float64]

log = logging.getLogger("brakeline.ros2")

RESEND = 0.05  # s after which an input is sent again
SILENCE = 0.5  # s for which a simulation's clock may stand still
LATE = 0.02  # s after a period's beginning at which an answer to it is too late
TELL = 1.0  # s between two diagnostics; a change is told at once


class UnsupportedRobot(ValueError):
    """Not a robot that Twist messages drive."""


@dataclass(frozen=True)
class Topics:
    """Names, below the namespace unless they begin with a slash."""

    odometry: str = "odom"
    scan: str = "scan"
    raw: str = "cmd_vel_raw"
    command: str = "cmd_vel"
    transforms: str = "/tf"
    fixed_transforms: str = "/tf_static"
    diagnostics: str = "/diagnostics"
    markers: str = "~/markers"


@dataclass(frozen=True)
class Ros2Settings:
    robot: str = "ground"
    ros: RosSettings = field(default_factory=RosSettings)
    name: str = "brakeline"
    topics: Topics = field(default_factory=Topics)
    stamped: bool = False  # TwistStamped instead of Twist, in and out
    sim_time: bool = False
    lead: float = 0.04  # s before a period at which its input is decided on
    sensing: SensorSettings = field(default_factory=SensorSettings)
    fresh: AgeLimits = field(default_factory=AgeLimits)
    seconds: float = 0.0  # by the robot's clock, until it ends; 0: when asked to


def driven(name: str) -> Robot:
    """The robot of that name in real time.

    Raises:
        UnknownRobot; UnsupportedRobot: a Twist can't drive it, or odometry can't tell its state.
    """
    robot = robot_maybe_with_task(name)
    robot = robot if robot.late else robot.in_real_time()
    if (robot.position_dim, robot.heading, robot.state_dim, robot.action_dim) != (2, 2, 5, 2):
        raise UnsupportedRobot(f"{robot.kind}: over ROS 2 a robot drives in the plane by speed and turn rate")
    return robot


class FilterNode:
    """A robot's node, and the loop that keeps its periods."""

    def __init__(
        self, settings: Ros2Settings, question: Ask, stop: threading.Event, tap: MessageTap | None = None
    ) -> None:
        """Raises Unreachable, BadRosName, UnknownRobot, UnsupportedRobot."""
        self.settings, self.robot, self._stop = settings, driven(settings.robot), stop
        self.senses = RosInputs(self.robot, settings.sensing, settings.fresh)
        self.gate = CommandGate(self.robot, question, settings.name)
        self.clock: RosClock = SimulatedClock() if settings.sim_time else SystemClock()
        self._why, self._ending = "not begun", False
        self._told = (-math.inf, "", "")  # when diagnostics went out, and what they said
        self.node = RosNode(settings.ros, settings.name, tap)
        names = settings.topics
        if settings.stamped:
            self._stamped: RosPublisher[TwistStamped] | None = self.node.publisher(names.command, TwistStamped)
        else:
            self._stamped, self._plain = None, self.node.publisher(names.command, Twist)
        self._markers = self.node.publisher(names.markers, MarkerArray)
        self._diagnostics = self.node.publisher(names.diagnostics, DiagnosticArray)
        self._listen()

    def run(self) -> None:
        """Until asked to stop; then along the committed plan to a stop."""
        due = self._first()
        ends = due + self.settings.seconds if self.settings.seconds else math.inf
        while not self._stop.is_set() and due < ends:
            due = self._period(due, self._stop)
        self._ending, unasked = True, threading.Event()
        while self.gate.backup_plan.plan.any():
            due = self._period(due, unasked)
        self._send(np.zeros(self.robot.action_dim))

    def close(self) -> None:
        self.node.close()

    def figures(self) -> dict[str, float]:
        """What became of the periods and messages so far."""
        return self.gate.tally.figures() | {"passed over": self.node.rejected.count}

    def _first(self) -> float:
        """When the first period begins: at a multiple of its length, as all do."""
        while self.clock.now() == 0.0 and not self._stop.is_set():  # a simulation that has not told yet
            self.clock.wait(1e-6, self._stop, SILENCE)
        self.clock.jumped()
        return math.ceil(self.clock.now() / self.robot.period) * self.robot.period

    def _period(self, due: float, stop: threading.Event) -> float:
        """Wait for the period that is due, let it begin, and decide on the one after it. Returns when that is due."""
        clock, gate, period = self.clock, self.gate, self.robot.period
        in_time = clock.now() <= due + LATE
        if not clock.wait(due, stop, SILENCE):
            if not stop.is_set():
                self._begin(why=f"the clock stands still at {clock.now():.2f} s")
            return due
        if jump := clock.jumped():
            log.warning("the clock was set by %.2f s", jump)
            self.senses.forget()
            self._why = "the clock was set"
        if jump or clock.now() > due + period:  # what was decided was for another moment
            gate.tally.slips += not jump
            in_time = False
            due = math.floor(clock.now() / period) * period
        number = gate.tally.periods
        self._begin(in_time, self._why)
        self._why = "" if self._until(due + period - self.settings.lead, stop) else "the clock stands still"
        if not self._why:
            self._decide(due, number)
        return due + period

    def _begin(self, in_time: bool = True, why: str = "") -> None:
        self._send(self.gate.begin(self.clock.now(), in_time, why))
        self._tell()

    def _decide(self, began: float, number: int) -> None:
        now = self.clock.now()
        try:
            if self._ending:
                raise InputMissing("the filter ends")
            state = self.senses.state(began, now)
            around: tuple[Obstacle, ...] = self.senses.obstacles(state[:2], now)
        except InputMissing as error:
            self._why = str(error)
            return
        self.gate.decide(state, around, self.senses.command(now), began, number)
        outcome = self.gate.outcome
        if outcome is not None and outcome.answer is not None:
            self._markers.put(markers(began, self.senses.frame, outcome.answer, around))

    def _until(self, moment: float, stop: threading.Event) -> bool:
        """Wait, and meanwhile send the input in force again (not in a simulation: it may wait for the next one)."""
        clock = self.clock
        while not self.settings.sim_time and moment - clock.now() > RESEND:
            if not clock.wait(clock.now() + RESEND, stop, SILENCE):
                return False
            self._send(self.gate.input)
        return clock.wait(moment, stop, SILENCE)

    def _send(self, action: Array) -> None:
        speed, turn_rate = map(float, action)
        message = twist(speed, turn_rate)
        if self._stamped is not None:
            self._stamped.put(TwistStamped(header=header(self.clock.now(), ""), twist=message))
        else:
            self._plain.put(message)

    def _tell(self) -> None:
        """Diagnostics: each second, and when something changes."""
        gate, now = self.gate, self.clock.now()
        when, *said = self._told
        if gate.kind != said[0]:
            lost = gate.kind not in KINDS
            log.log(logging.WARNING if lost else logging.INFO, "%s: %s", gate.kind, gate.reason)
        if [gate.kind, gate.reason] == said and now - when < TELL:
            return
        self._told = (now, gate.kind, gate.reason)
        self._diagnostics.put(
            diagnostics(now, self.settings.name, self.robot.name, gate.kind, gate.reason, self.figures())
        )

    def _listen(self) -> None:
        names, senses, subscribe = self.settings.topics, self.senses, self.node.subscribe
        if isinstance(self.clock, SimulatedClock):
            subscribe("/clock", Clock, self.clock.hear, SENSOR)
        subscribe(names.fixed_transforms, TFMessage, senses.hear_fixed_transforms, LATCHED)
        if self.settings.sensing.base_frame:
            subscribe(names.transforms, TFMessage, senses.hear_transforms)
        else:
            subscribe(names.odometry, Odometry, senses.hear_odometry, SENSOR)
        subscribe(names.scan, LaserScan, senses.hear_scan, SENSOR)
        hear = lambda message: senses.hear_command(message, self.clock.now())  # noqa: E731
        if self.settings.stamped:
            subscribe(names.raw, TwistStamped, hear)
        else:
            subscribe(names.raw, Twist, hear)


def run(
    settings: Ros2Settings, question: Ask, stop: threading.Event, tap: MessageTap | None = None
) -> dict[str, float]:
    """Steer until asked to stop; returns what became of the periods."""
    steering = FilterNode(settings, question, stop, tap)
    try:
        steering.run()
    finally:
        steering.close()
    return steering.figures()

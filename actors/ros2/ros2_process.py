"""PROCESS: filter the raw commands of a ROS 2 robot, and drive its base by what the filter allows.

Periods follow each other by the robot's clock. The process sends the input of a period at its beginning, and again
every `RESEND` seconds. `lead` seconds before the period ends, it asks for a decision on the newest raw command. The
next period gets the input of the answer. If there is no answer, or if a measurement or command that a decision needs
is missing or stale, the robot brakes along the committed plan. If this process dies, the base's own timeout brakes.
"""

from __future__ import annotations

import logging
import math
import threading
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from brakeline.actors.decision_guard import Ask
from brakeline.actors.ros2.command_gate import CommandGate
from brakeline.actors.ros2.ros2_settings import AgeLimits, SensorSettings, Topics
from brakeline.actors.ros2.ros_clock import RosSimulatedClock, SystemClock
from brakeline.actors.ros2.ros_inputs import RosInputs
from brakeline.actors.ros2.ros_views import diagnostics, markers
from brakeline.errors import InputMissing, Mismatch, PoseJumped
from brakeline.messaging.number_checks import check_numbers
from brakeline.messaging.obstacle import Obstacle
from brakeline.messaging.robot import Array, Robot
from brakeline.messaging.ros2 import ALL_LATCHED, SENSOR, MessageTap, RosNode, RosPublisher, RosSettings
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
from brakeline.safety.service.wire import KIND_NUMBERS

log = logging.getLogger("brakeline.ros2")

RESEND = 0.05  # s after which an input is sent again
SILENCE = 0.5  # s for which a simulation's clock may stand still
LATE = 0.02  # s after its due time: a period that begins later is late
DIAGNOSTICS_INTERVAL = 1.0  # s between two diagnostics, unless the decision changes


@dataclass(frozen=True)
class Ros2Settings:
    """Settings of the process."""

    robot: str = "ground"
    ros: RosSettings = field(default_factory=RosSettings)
    name: str = "brakeline"
    topics: Topics = field(default_factory=Topics)
    stamped: bool = False  # whether commands are TwistStamped instead of Twist
    sim_time: bool = False  # whether the time is on /clock
    lead: float = 0.04  # s before a period, at which the filter decides about its input
    sensors: SensorSettings = field(default_factory=SensorSettings)
    age_limits: AgeLimits = field(default_factory=AgeLimits)
    turn_aside: bool = False  # whether the filter turns a blocked robot aside
    seconds: float = 0.0  # s by the robot's clock until the end; 0: until the process is asked to stop

    def __post_init__(self) -> None:
        check_numbers(self, "lead", above=0.0)
        check_numbers(self, "seconds", least=0.0)


def driven(name: str) -> Robot:
    """Return the robot with this name, described in real time.

    Raises:
        UnknownRobot: there is none.
        Mismatch: a Twist cannot drive it, or odometry does not contain its state.
    """
    robot = robot_maybe_with_task(name)
    robot = robot if robot.late else robot.in_real_time()
    if (robot.position_dim, robot.heading, robot.state_dim, robot.action_dim) != (2, 2, 5, 2):
        raise Mismatch(
            f"{robot.kind}: `brakeline ros2` is for robots that drive in the plane by speed and turn rate. For others, "
            "use `SafetyClient`"
        )
    return robot


class FilterNode:
    """The node of one robot, and the loop over its periods."""

    def __init__(self, settings: Ros2Settings, ask: Ask, stop: threading.Event, tap: MessageTap | None = None) -> None:
        """Set up the gate, the clock and the inputs, and join the graph. tap: called with every message.

        Raises:
            Unreachable, BadRosName, UnknownRobot, Mismatch: the message says what to do.
        """
        self.settings, self.robot, self._stop = settings, driven(settings.robot), stop
        self.inputs = RosInputs(self.robot, settings.sensors, settings.age_limits)
        self.gate = CommandGate(self.robot, ask, settings.name, settings.turn_aside)
        self.clock = RosSimulatedClock() if settings.sim_time else SystemClock()
        self._missing = "not begun"  # why there is no decision about the next period; empty: there is one
        self._error_logged = False  # since the last decision
        self._ending = False
        self._diagnosed_at, self._diagnosed = -math.inf, ("", "")  # s; kind and reason of the last diagnostics
        self.node = RosNode(settings.ros, settings.name, tap)
        names = settings.topics
        self._twist: type[Any] = TwistStamped if settings.stamped else Twist
        self._commands: RosPublisher[Any] = self.node.publisher(names.command, self._twist)
        self._markers = self.node.publisher(names.markers, MarkerArray)
        self._diagnostics = self.node.publisher(names.diagnostics, DiagnosticArray)
        self._subscribe()
        self._commanders, self._senders = (self.node.other_publishers(name) for name in (names.command, names.raw))

    def run(self) -> None:
        """Run until asked to stop; then follow the committed plan to a stop."""
        due = self._first_period()
        ends = due + self.settings.seconds if self.settings.seconds else math.inf
        try:
            while not self._stop.is_set() and due < ends:
                due = self._period(due, self._stop)
        finally:  # also after an error: the base would go on with the last command until its own timeout
            self._ending, never = True, threading.Event()
            while self.gate.backup_plan.plan.any():
                due = self._period(due, never)
            self._send(np.zeros(self.robot.action_dim))

    def close(self) -> None:
        self.node.close()

    def figures(self) -> dict[str, float]:
        """Return the statistics of periods and messages so far."""
        return self.gate.stats.figures() | {"passed over": self.node.rejected.count}

    def _first_period(self) -> float:
        """Return when the first period begins [s]. All periods begin at multiples of their length."""
        while self.clock.now() == 0.0 and not self._stop.is_set():  # a simulation that has not sent its time yet
            self.clock.wait(1e-6, self._stop, SILENCE)
        self.clock.jumped()
        return math.ceil(self.clock.now() / self.robot.period) * self.robot.period

    def _period(self, due: float, stop: threading.Event) -> float:
        """Wait until `due` [s], begin a period, and decide about the next one. Return when that begins [s]."""
        clock, gate, period = self.clock, self.gate, self.robot.period
        if not clock.wait(due, stop, SILENCE):
            if not stop.is_set():
                self._begin(why=f"the clock stands still at {clock.now():.2f} s")
            return due
        if jump := clock.jumped():
            log.warning("the clock was set by %.2f s", jump)
            self.inputs.forget()
            gate.backup_plan.distrust()  # a simulation that began anew placed the robot elsewhere
            self._missing = "the clock was set"
        late = bool(jump) or clock.now() > due + LATE  # the decision was for another time
        if late:
            if not jump:
                gate.slip(int((clock.now() - due) / period))
            due = math.floor(clock.now() / period) * period
        number = gate.stats.periods
        self._begin(not late, self._missing)
        decide_at = due + period - self.settings.lead
        self._missing = "" if self._resend_until(decide_at, stop) else "the clock stands still"
        if late:  # the base executed two inputs in this period, so its end cannot be predicted
            self._missing = self._missing or "the period before began late"
        elif not self._missing:
            self._decide(due, number)
        return due + period

    def _begin(self, in_time: bool = True, why: str = "") -> None:
        self._send(self.gate.begin(self.clock.now(), in_time, why))
        self._diagnose()

    def _decide(self, began: float, number: int) -> None:
        now = self.clock.now()
        try:
            if self._ending:
                raise InputMissing("the filter ends")
            self._check_publishers(now)
            state = self.inputs.state(began, now)
            around: tuple[Obstacle, ...] = self.inputs.obstacles(state[:2], now)
            self.gate.decide(state, around, self.inputs.command(now), began, number)
        except InputMissing as error:
            if isinstance(error, PoseJumped):
                self.gate.backup_plan.distrust()
            self._missing = str(error)
            return
        except Exception as error:  # whatever a message holds: without a decision the robot brakes along its plan
            if not self._error_logged:
                log.exception("no decision")
            self._missing, self._error_logged = f"no decision: {type(error).__name__}: {error}", True
            return
        self._error_logged = False
        outcome = self.gate.outcome
        if outcome is not None and outcome.answer is not None:
            self._markers.put(markers(began, self.inputs.frame, outcome.answer, around))

    def _check_publishers(self, now: float) -> None:
        """Raise InputMissing if another node commands the base too, or if all raw commands have another type."""
        topics = self.settings.topics
        if others := self._commanders.nodes():
            raise InputMissing(
                f"{', '.join(others)} publishes on {topics.command} too, past the filter: let it publish on "
                f"{topics.raw}"
            )
        if self.inputs.command(now) is None and (others := self._senders.of_other_type(self._twist)):
            hint = "leave out --stamped" if self.settings.stamped else "give --stamped if it sends TwistStamped"
            raise InputMissing(f"{', '.join(others)} sends {topics.raw} as another type than we expect: {hint}")

    def _resend_until(self, moment: float, stop: threading.Event) -> bool:
        """Wait for a moment [s], and send the input in force again meanwhile. Return False as `SystemClock.wait` does.

        In a simulation, the process sends no input again, because each command may start the simulation's next step.
        """
        clock = self.clock
        while not self.settings.sim_time and moment - clock.now() > RESEND:
            if not clock.wait(clock.now() + RESEND, stop, SILENCE):
                return False
            self._send(self.gate.input)
        return clock.wait(moment, stop, SILENCE)

    def _send(self, action: Array) -> None:
        message, now = twist(*map(float, action)), self.clock.now()
        self.inputs.executed(action, now)
        self._commands.put(TwistStamped(header=header(now, ""), twist=message) if self.settings.stamped else message)

    def _diagnose(self) -> None:
        """Publish diagnostics every second and when the decision changes; log a change of its kind."""
        gate, now = self.gate, self.clock.now()
        if gate.kind != self._diagnosed[0]:
            log.log(logging.INFO if gate.kind in KIND_NUMBERS else logging.WARNING, "%s: %s", gate.kind, gate.reason)
        if (gate.kind, gate.reason) == self._diagnosed and now - self._diagnosed_at < DIAGNOSTICS_INTERVAL:
            return
        self._diagnosed_at, self._diagnosed = now, (gate.kind, gate.reason)
        self._diagnostics.put(
            diagnostics(now, self.settings.name, self.robot.name, gate.kind, gate.reason, self.figures())
        )

    def _subscribe(self) -> None:
        names, inputs, subscribe = self.settings.topics, self.inputs, self.node.subscribe
        if isinstance(self.clock, RosSimulatedClock):
            subscribe("/clock", Clock, self.clock.on_clock, SENSOR)
        subscribe(names.fixed_transforms, TFMessage, inputs.on_fixed_transforms, ALL_LATCHED)
        if self.settings.sensors.base_frame:
            subscribe(names.transforms, TFMessage, inputs.on_transforms)
        else:
            subscribe(names.odometry, Odometry, inputs.on_odometry, SENSOR)
        subscribe(names.scan, LaserScan, inputs.on_scan, SENSOR)
        subscribe(names.raw, self._twist, lambda message: inputs.on_command(message, self.clock.now()))


def run(settings: Ros2Settings, ask: Ask, stop: threading.Event, tap: MessageTap | None = None) -> dict[str, float]:
    """Filter commands until asked to stop. Return the statistics of periods and messages."""
    node = FilterNode(settings, ask, stop, tap)
    try:
        node.run()
    finally:
        node.close()
    return node.figures()

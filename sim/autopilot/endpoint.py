"""One vehicle's MAVLink endpoint: bytes in, bytes out, time injected."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from brakeline.sim.autopilot import ned_frames
from brakeline.sim.autopilot.autopilot_rules import RULES
from brakeline.sim.autopilot.common_dialect import mavlink
from brakeline.sim.autopilot.flight_modes import CommandRefused, FlightStateMachine, Mode, UnknownMode
from brakeline.sim.autopilot.parameters import BadParameter
from brakeline.sim.autopilot.telemetry_sender import BUILDERS, StreamSchedule, TelemetryBuilder
from brakeline.sim.lidar import Lidar
from brakeline.sim.quadrotor import Quadrotor

TICK = 0.02  # s between two looks at modes, timeouts and streams; the vehicle's own control runs faster
HEARTBEAT = mavlink.MAVLINK_MSG_ID_HEARTBEAT
FORCED = 21196.0  # param2 of an arming command that is to be carried out regardless
ACCEPTED, DENIED = int(mavlink.MAV_RESULT_ACCEPTED), int(mavlink.MAV_RESULT_DENIED)
FAILED = int(mavlink.MAV_RESULT_FAILED)


class UnknownRules(ValueError):
    """There is no such rule set."""


@dataclass(frozen=True)
class Command:
    """COMMAND_LONG and COMMAND_INT alike."""

    number: int
    params: tuple[float, ...]  # 1 to 7
    frame: int  # of the seventh


class Outbox(bytearray):
    """What pymavlink writes to."""

    def write(self, data: bytes) -> None:
        self.extend(data)


class Autopilot:
    """A simulated vehicle behind MAVLink 2. `advance` lets time pass for the vehicle and sends telemetry.

    system: its MAVLink system id. A message to another system or component is not heard; a frame that is damaged is
    dropped. The vehicle is the caller's, for what a real one would not tell: its true state and its collisions.
    """

    def __init__(
        self,
        vehicle: Quadrotor,
        rules: str = "px4",
        system: int = 1,
        parameters: dict[str, float] | None = None,
        lidar: Lidar | None = None,
        quiet: bool = False,
    ) -> None:
        """parameters: other values than the table's; lidar: for OBSTACLE_DISTANCE; quiet: nothing but the heartbeat is
        sent without being asked for.

        Raises:
            UnknownRules, BadParameter.
        """
        if rules not in RULES:
            raise UnknownRules(f"no rule set is called {rules!r}; there are: {', '.join(RULES)}")
        self.vehicle, self.rules = vehicle, RULES[rules]()
        for name, value in (parameters or {}).items():
            self.rules.parameters.set(name, value)
        self.pilot = FlightStateMachine(vehicle, self.rules.limits(), self.rules.boots_in)
        self.reports = TelemetryBuilder(self.pilot, lidar)
        self._ticks = round(TICK / vehicle.timestep)
        self._outbox = Outbox()
        self.mav = mavlink.MAVLink(self._outbox, srcSystem=system, srcComponent=mavlink.MAV_COMP_ID_AUTOPILOT1)
        self.mav.robust_parsing = True
        self.schedule = StreamSchedule(TICK)
        self.schedule.set(HEARTBEAT, 1.0, 0.0)
        for kind, rate in () if quiet else self.rules.rates.items():
            self.schedule.set(kind, 1.0 / rate, 0.0)
        self._heartbeat()

    @property
    def system(self) -> int:
        """Its MAVLink system id."""
        return int(self.mav.srcSystem)

    def receive(self, data: bytes) -> None:
        """Bytes from the link, in pieces of any size."""
        for message in self.mav.parse_buffer(data) or ():
            handler = HANDLERS.get(message.get_msgId())
            if handler is not None and self._for_me(message):
                handler(self, message)

    def take(self) -> bytes:
        """The bytes to be sent since the last call."""
        data = bytes(self._outbox)
        self._outbox.clear()
        return data

    def advance(self, seconds: float) -> None:
        """Let time pass, in whole ticks of `TICK`."""
        pilot, send, schedule = self.pilot, self.mav.send, self.schedule
        for _ in range(round(seconds / TICK)):
            pilot.steer(TICK)
            self.vehicle.fly(self._ticks)
            pilot.tick(TICK)
            if pilot.news:
                self._tell_news()
            for kind in schedule.due(pilot.time):
                if kind == HEARTBEAT:
                    self._heartbeat()
                elif (message := self.reports.build(kind)) is not None:
                    send(message)

    def knows(self, kind: int) -> bool:
        """It can send that message."""
        return kind == HEARTBEAT or (kind in BUILDERS and kind not in self.rules.lacks)

    def say(self, text: str, severity: int = mavlink.MAV_SEVERITY_WARNING) -> None:
        """STATUSTEXT, cut to its 50 bytes."""
        self.mav.statustext_send(severity, text.encode()[:50])

    def _for_me(self, message: mavlink.MAVLink_message) -> bool:
        system = getattr(message, "target_system", 0)
        component = getattr(message, "target_component", 0)
        return system in (0, self.system) and component in (0, mavlink.MAV_COMP_ID_AUTOPILOT1)

    def _tell_news(self) -> None:
        for text in self.pilot.news:
            self.say(text, mavlink.MAV_SEVERITY_INFO)
        self.pilot.news.clear()

    def _heartbeat(self) -> None:
        armed = self.pilot.armed
        mode = mavlink.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED | mavlink.MAV_MODE_FLAG_STABILIZE_ENABLED
        mode |= mavlink.MAV_MODE_FLAG_GUIDED_ENABLED | (mavlink.MAV_MODE_FLAG_SAFETY_ARMED if armed else 0)
        self.mav.heartbeat_send(
            mavlink.MAV_TYPE_QUADROTOR,
            self.rules.autopilot,
            mode,
            self.rules.custom_mode(self.pilot),
            mavlink.MAV_STATE_ACTIVE if armed else mavlink.MAV_STATE_STANDBY,
        )

    def _heading(self) -> float:
        """rad from north."""
        return ned_frames.yaw(ned_frames.heading(self.reports.estimate.attitude))

    def _on_setpoint(self, message: mavlink.MAVLink_set_position_target_local_ned_message) -> None:
        try:
            self.rules.setpoint(self.pilot, message, self._heading())
        except CommandRefused as refusal:
            self.say(str(refusal), mavlink.MAV_SEVERITY_CRITICAL)

    def _on_command_long(self, message: mavlink.MAVLink_command_long_message) -> None:
        m = message
        params = (m.param1, m.param2, m.param3, m.param4, m.param5, m.param6, m.param7)
        self._command(message, Command(m.command, params, mavlink.MAV_FRAME_GLOBAL_RELATIVE_ALT))

    def _on_command_int(self, message: mavlink.MAVLink_command_int_message) -> None:
        m = message
        params = (m.param1, m.param2, m.param3, m.param4, float(m.x), float(m.y), m.z)
        self._command(message, Command(m.command, params, m.frame))

    def _command(self, message: mavlink.MAVLink_message, command: Command) -> None:
        """Carry out, and say how it went."""
        action = ACTIONS.get(command.number)
        try:
            result = mavlink.MAV_RESULT_UNSUPPORTED if action is None else action(self, command)
        except CommandRefused as refusal:
            unknown = isinstance(refusal, UnknownMode)
            result = mavlink.MAV_RESULT_UNSUPPORTED if unknown else self.rules.refusal
            self.say(str(refusal))
        self.mav.command_ack_send(command.number, result, 0, 0, message.get_srcSystem(), message.get_srcComponent())
        self._tell_news()

    def _on_set_mode(self, message: mavlink.MAVLink_set_mode_message) -> None:
        try:
            if message.base_mode & mavlink.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED:
                self.rules.change(self.pilot, message.custom_mode)
        except CommandRefused as refusal:
            self.say(str(refusal))

    def _on_data_stream(self, message: mavlink.MAVLink_request_data_stream_message) -> None:
        for kind in self.rules.groups.get(message.req_stream_id, ()):
            rate = message.req_message_rate if message.start_stop else 0
            self.schedule.set(kind, 1.0 / rate if rate else 0.0, self.pilot.time)

    def _on_list(self, _: mavlink.MAVLink_message) -> None:
        parameters = self.rules.parameters
        for index in range(len(parameters.table)):
            self.mav.send(parameters.message(index))

    def _on_read(self, message: mavlink.MAVLink_param_request_read_message) -> None:
        parameters = self.rules.parameters
        try:
            index = message.param_index if message.param_index >= 0 else parameters.find(message.param_id)
            self.mav.send(parameters.message(index))
        except (BadParameter, IndexError):
            self.say(f"unknown parameter {message.param_id or message.param_index}")

    def _on_set(self, message: mavlink.MAVLink_param_set_message) -> None:
        """Answered with the value that it now has, the new one or, refused, the old one."""
        parameters, name = self.rules.parameters, message.param_id
        try:
            parameters.set(name, parameters.sent(name, message.param_value, message.param_type))
            self.pilot.limits = self.rules.limits()
        except BadParameter as error:
            self.say(str(error))
        try:
            self.mav.send(parameters.message(parameters.find(name)))
        except BadParameter:
            return

    def _on_time(self, message: mavlink.MAVLink_timesync_message) -> None:
        if message.tc1 == 0:
            self.mav.timesync_send(round(1e9 * self.pilot.time), message.ts1)


HANDLERS: dict[int, Callable[[Autopilot, Any], None]] = {
    mavlink.MAVLINK_MSG_ID_SET_POSITION_TARGET_LOCAL_NED: Autopilot._on_setpoint,
    mavlink.MAVLINK_MSG_ID_COMMAND_LONG: Autopilot._on_command_long,
    mavlink.MAVLINK_MSG_ID_COMMAND_INT: Autopilot._on_command_int,
    mavlink.MAVLINK_MSG_ID_SET_MODE: Autopilot._on_set_mode,
    mavlink.MAVLINK_MSG_ID_REQUEST_DATA_STREAM: Autopilot._on_data_stream,
    mavlink.MAVLINK_MSG_ID_PARAM_REQUEST_LIST: Autopilot._on_list,
    mavlink.MAVLINK_MSG_ID_PARAM_REQUEST_READ: Autopilot._on_read,
    mavlink.MAVLINK_MSG_ID_PARAM_SET: Autopilot._on_set,
    mavlink.MAVLINK_MSG_ID_TIMESYNC: Autopilot._on_time,
}


def _arm_disarm(autopilot: Autopilot, command: Command) -> int:
    switch, force = command.params[0], command.params[1] == FORCED
    if switch not in (0.0, 1.0):
        return int(mavlink.MAV_RESULT_UNSUPPORTED)
    if switch:
        autopilot.rules.arm(autopilot.pilot)
    else:
        autopilot.pilot.disarm(force)
    return ACCEPTED


def _take_off(autopilot: Autopilot, command: Command) -> int:
    if command.frame != mavlink.MAV_FRAME_GLOBAL_RELATIVE_ALT and autopilot.rules.name == "ardupilot":
        return DENIED
    autopilot.rules.take_off(autopilot.pilot, command.params[6])
    return ACCEPTED


def _land(autopilot: Autopilot, _: Command) -> int:
    autopilot.pilot.change(Mode.LAND)
    return ACCEPTED


def _set_mode(autopilot: Autopilot, command: Command) -> int:
    base, main, sub = (round(p) if math.isfinite(p) else 0 for p in command.params[:3])
    if not base & mavlink.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED:
        return DENIED
    autopilot.rules.change(autopilot.pilot, autopilot.rules.command_mode(main, sub))
    return ACCEPTED


def _set_interval(autopilot: Autopilot, command: Command) -> int:
    """param1: message id; param2: µs; 0: the default rate; -1: none."""
    kind, microseconds = round(command.params[0]), command.params[1]
    if not autopilot.knows(kind):
        autopilot.say(f"message {kind} is not known")
        return FAILED
    interval = 1e-6 * microseconds
    if microseconds == 0.0:
        interval = 1.0 / autopilot.rules.rates[kind] if kind in autopilot.rules.rates else 0.0
    elif 0.0 < interval < TICK - 1e-9:
        interval = TICK  # no faster than it is
    autopilot.schedule.set(kind, interval, autopilot.pilot.time)
    return ACCEPTED


def _get_interval(autopilot: Autopilot, command: Command) -> int:
    kind = round(command.params[0])
    if not autopilot.knows(kind):
        return DENIED
    interval = autopilot.schedule.interval(kind)
    autopilot.mav.message_interval_send(kind, round(1e6 * interval) if interval else -1)
    return ACCEPTED


def _request_message(autopilot: Autopilot, command: Command) -> int:
    kind = round(command.params[0])
    message = autopilot.reports.build(kind) if kind in BUILDERS and autopilot.knows(kind) else None
    if message is None:
        return int(mavlink.MAV_RESULT_UNSUPPORTED)
    autopilot.mav.send(message)
    return ACCEPTED


def _request_capabilities(autopilot: Autopilot, _: Command) -> int:
    autopilot.mav.send(autopilot.reports.autopilot_version())
    return ACCEPTED


ACTIONS: dict[int, Callable[[Autopilot, Command], int]] = {
    mavlink.MAV_CMD_COMPONENT_ARM_DISARM: _arm_disarm,
    mavlink.MAV_CMD_NAV_TAKEOFF: _take_off,
    mavlink.MAV_CMD_NAV_LAND: _land,
    mavlink.MAV_CMD_DO_SET_MODE: _set_mode,
    mavlink.MAV_CMD_SET_MESSAGE_INTERVAL: _set_interval,
    mavlink.MAV_CMD_GET_MESSAGE_INTERVAL: _get_interval,
    mavlink.MAV_CMD_REQUEST_MESSAGE: _request_message,
    mavlink.MAV_CMD_REQUEST_AUTOPILOT_CAPABILITIES: _request_capabilities,
}

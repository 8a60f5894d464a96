"""The MAVLink endpoint of one simulated vehicle: bytes in, bytes out; the caller advances time."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from brakeline.errors import BadParameter, RequestRefused, UnknownMode, UnknownRules
from brakeline.sim.autopilot import ned_frames
from brakeline.sim.autopilot.autopilot_rules import RULES
from brakeline.sim.autopilot.common_dialect import mavlink
from brakeline.sim.autopilot.flight_modes import FlightStateMachine, Mode
from brakeline.sim.autopilot.parameters import Parameters
from brakeline.sim.autopilot.telemetry_sender import BUILDERS, StreamSchedule, TelemetryBuilder
from brakeline.sim.ground_estimator import heading_of
from brakeline.sim.lidar import Lidar
from brakeline.sim.quadrotor import Quadrotor

TICK = 0.02  # s between two updates of modes, timeouts and streams; the flight controller runs faster
HEARTBEAT = mavlink.MAVLINK_MSG_ID_HEARTBEAT
FORCED = 21196.0  # param2 of an arming command that skips all checks
ACCEPTED, DENIED = int(mavlink.MAV_RESULT_ACCEPTED), int(mavlink.MAV_RESULT_DENIED)
FAILED = int(mavlink.MAV_RESULT_FAILED)


@dataclass(frozen=True)
class Command:
    """A COMMAND_LONG or COMMAND_INT."""

    number: int
    params: tuple[float, ...]  # 1 to 7
    frame: int  # MAV_FRAME of the seventh


class _SendBuffer(bytearray):
    """The file that pymavlink writes to."""

    def write(self, data: bytes) -> None:
        self.extend(data)


class Autopilot:
    """A simulated vehicle behind MAVLink 2. `advance` advances the vehicle and sends telemetry.

    The endpoint ignores messages to another system or component, and drops damaged frames.

    Attributes:
        vehicle: the simulated vehicle, also for its true state and its collisions.
        rules: of PX4 or of ArduCopter.
        parameters: their values.
        flight: the flight modes.
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
        """Connect the autopilot to a vehicle.

        Args:
            rules: `px4` or `ardupilot`.
            system: MAVLink system id.
            parameters: values that replace the defaults.
            lidar: the source of OBSTACLE_DISTANCE.
            quiet: send only the heartbeat, and messages on request.

        Raises:
            UnknownRules: no rule set has this name.
            BadParameter: a parameter does not exist, or cannot have this value.
        """
        if rules not in RULES:
            raise UnknownRules(f"no rule set is called {rules!r}; there are: {', '.join(RULES)}")
        self.vehicle, self.rules = vehicle, RULES[rules]
        self.parameters = Parameters(self.rules.parameters, self.rules.bitwise_integers)
        for name, value in (parameters or {}).items():
            self.parameters.set(name, value)
        self.flight = FlightStateMachine(vehicle, self.rules.limits(self.parameters), self.rules.initial_mode)
        self.telemetry = TelemetryBuilder(self.flight, lidar)
        self._ticks = round(TICK / vehicle.timestep)
        self._send_buffer = _SendBuffer()
        self.mav = mavlink.MAVLink(self._send_buffer, srcSystem=system, srcComponent=mavlink.MAV_COMP_ID_AUTOPILOT1)
        self.mav.robust_parsing = True
        self.schedule = StreamSchedule(TICK)
        self.schedule.set(HEARTBEAT, 1.0, 0.0)
        for kind, rate in () if quiet else self.rules.rates.items():
            self.schedule.set(kind, 1.0 / rate, 0.0)
        self._heartbeat()

    @property
    def system(self) -> int:
        """The MAVLink system id."""
        return int(self.mav.srcSystem)

    def receive(self, data: bytes) -> None:
        """Handle bytes from the link, in pieces of any size."""
        for message in self.mav.parse_buffer(data) or ():
            handler = HANDLERS.get(message.get_msgId())
            if handler is not None and self._for_me(message):
                handler(self, message)

    def take(self) -> bytes:
        """Return the bytes to send since the last call."""
        data = bytes(self._send_buffer)
        self._send_buffer.clear()
        return data

    def advance(self, seconds: float) -> None:
        """Advance time, in whole ticks of `TICK`."""
        flight, send, schedule = self.flight, self.mav.send, self.schedule
        for _ in range(round(seconds / TICK)):
            flight.steer(TICK)
            self.vehicle.advance(self._ticks)
            flight.tick(TICK)
            if flight.announcements:
                self._send_announcements()
            for kind in schedule.due(flight.time):
                if kind == HEARTBEAT:
                    self._heartbeat()
                elif (message := self.telemetry.build(kind)) is not None:
                    send(message)

    def can_send(self, kind: int) -> bool:
        """Return whether the autopilot knows this message."""
        return kind == HEARTBEAT or (kind in BUILDERS and kind not in self.rules.unsupported)

    def send_text(self, text: str, severity: int = mavlink.MAV_SEVERITY_WARNING) -> None:
        """Send a STATUSTEXT, cut to its 50 bytes."""
        self.mav.statustext_send(severity, text.encode()[:50])

    def _for_me(self, message: mavlink.MAVLink_message) -> bool:
        system = getattr(message, "target_system", 0)
        component = getattr(message, "target_component", 0)
        return system in (0, self.system) and component in (0, mavlink.MAV_COMP_ID_AUTOPILOT1)

    def _send_announcements(self) -> None:
        for text in self.flight.announcements:
            self.send_text(text, mavlink.MAV_SEVERITY_INFO)
        self.flight.announcements.clear()

    def _heartbeat(self) -> None:
        armed = self.flight.armed
        mode = mavlink.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED | mavlink.MAV_MODE_FLAG_STABILIZE_ENABLED
        mode |= mavlink.MAV_MODE_FLAG_GUIDED_ENABLED | (mavlink.MAV_MODE_FLAG_SAFETY_ARMED if armed else 0)
        self.mav.heartbeat_send(
            mavlink.MAV_TYPE_QUADROTOR,
            self.rules.autopilot,
            mode,
            self.rules.custom_mode(self.flight),
            mavlink.MAV_STATE_ACTIVE if armed else mavlink.MAV_STATE_STANDBY,
        )

    def _heading(self) -> float:
        """Return the heading, rad from north."""
        return ned_frames.yaw(heading_of(self.telemetry.estimate.attitude))

    def _on_setpoint(self, message: mavlink.MAVLink_set_position_target_local_ned_message) -> None:
        try:
            self.rules.setpoint(self.flight, message, self._heading())
        except RequestRefused as refusal:
            self.send_text(str(refusal), mavlink.MAV_SEVERITY_CRITICAL)

    def _on_command_long(self, message: mavlink.MAVLink_command_long_message) -> None:
        m = message
        params = (m.param1, m.param2, m.param3, m.param4, m.param5, m.param6, m.param7)
        self._command(message, Command(m.command, params, mavlink.MAV_FRAME_GLOBAL_RELATIVE_ALT))

    def _on_command_int(self, message: mavlink.MAVLink_command_int_message) -> None:
        m = message
        params = (m.param1, m.param2, m.param3, m.param4, float(m.x), float(m.y), m.z)
        self._command(message, Command(m.command, params, m.frame))

    def _command(self, message: mavlink.MAVLink_message, command: Command) -> None:
        """Carry out a command and acknowledge it."""
        action = ACTIONS.get(command.number)
        try:
            result = mavlink.MAV_RESULT_UNSUPPORTED if action is None else action(self, command)
        except RequestRefused as refusal:
            unknown = isinstance(refusal, UnknownMode)
            result = mavlink.MAV_RESULT_UNSUPPORTED if unknown else self.rules.refusal
            self.send_text(str(refusal))
        self.mav.command_ack_send(command.number, result, 0, 0, message.get_srcSystem(), message.get_srcComponent())
        self._send_announcements()

    def _on_set_mode(self, message: mavlink.MAVLink_set_mode_message) -> None:
        try:
            if message.base_mode & mavlink.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED:
                self.rules.change(self.flight, message.custom_mode)
        except RequestRefused as refusal:
            self.send_text(str(refusal))

    def _on_data_stream(self, message: mavlink.MAVLink_request_data_stream_message) -> None:
        for kind in self.rules.stream_groups.get(message.req_stream_id, ()):
            rate = message.req_message_rate if message.start_stop else 0
            self.schedule.set(kind, 1.0 / rate if rate else 0.0, self.flight.time)

    def _on_list(self, _: mavlink.MAVLink_message) -> None:
        parameters = self.parameters
        for index in range(len(parameters.table)):
            self.mav.send(parameters.message(index))

    def _on_read(self, message: mavlink.MAVLink_param_request_read_message) -> None:
        parameters = self.parameters
        try:
            index = message.param_index if message.param_index >= 0 else parameters.index(message.param_id)
            self.mav.send(parameters.message(index))
        except (BadParameter, IndexError):
            self.send_text(f"unknown parameter {message.param_id or message.param_index}")

    def _on_set(self, message: mavlink.MAVLink_param_set_message) -> None:
        """Set a parameter, and answer with its value: the new one, or the old one if the new one is refused."""
        parameters, name = self.parameters, message.param_id
        try:
            parameters.set(name, parameters.decode(name, message.param_value, message.param_type))
            self.flight.limits = self.rules.limits(self.parameters)
        except BadParameter as error:
            self.send_text(str(error))
        try:
            self.mav.send(parameters.message(parameters.index(name)))
        except BadParameter:
            return

    def _on_time(self, message: mavlink.MAVLink_timesync_message) -> None:
        if message.tc1 == 0:
            self.mav.timesync_send(round(1e9 * self.flight.time), message.ts1)


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
        autopilot.rules.arm(autopilot.flight)
    else:
        autopilot.flight.disarm(force)
    return ACCEPTED


def _take_off(autopilot: Autopilot, command: Command) -> int:
    frames = autopilot.rules.takeoff_frames
    if frames is not None and command.frame not in frames:
        return DENIED
    autopilot.rules.take_off(autopilot.flight, command.params[6])
    return ACCEPTED


def _land(autopilot: Autopilot, _: Command) -> int:
    autopilot.flight.change(Mode.LAND)
    return ACCEPTED


def _set_mode(autopilot: Autopilot, command: Command) -> int:
    base, main, sub = (round(p) if math.isfinite(p) else 0 for p in command.params[:3])
    if not base & mavlink.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED:
        return DENIED
    autopilot.rules.change(autopilot.flight, autopilot.rules.mode_number(main, sub))
    return ACCEPTED


def _set_interval(autopilot: Autopilot, command: Command) -> int:
    """Set the interval of a message. param1: message id; param2: µs, 0 for the default rate, -1 to stop."""
    kind, microseconds = round(command.params[0]), command.params[1]
    if not autopilot.can_send(kind):
        autopilot.send_text(f"message {kind} is not known")
        return FAILED
    interval = 1e-6 * microseconds
    if microseconds == 0.0:
        interval = 1.0 / autopilot.rules.rates[kind] if kind in autopilot.rules.rates else 0.0
    elif 0.0 < interval < TICK - 1e-9:
        interval = TICK
    autopilot.schedule.set(kind, interval, autopilot.flight.time)
    return ACCEPTED


def _get_interval(autopilot: Autopilot, command: Command) -> int:
    kind = round(command.params[0])
    if not autopilot.can_send(kind):
        return DENIED
    interval = autopilot.schedule.interval(kind)
    autopilot.mav.message_interval_send(kind, round(1e6 * interval) if interval else -1)
    return ACCEPTED


def _request_message(autopilot: Autopilot, command: Command) -> int:
    kind = round(command.params[0])
    message = autopilot.telemetry.build(kind) if kind in BUILDERS and autopilot.can_send(kind) else None
    if message is None:
        return int(mavlink.MAV_RESULT_UNSUPPORTED)
    autopilot.mav.send(message)
    return ACCEPTED


def _request_capabilities(autopilot: Autopilot, _: Command) -> int:
    autopilot.mav.send(autopilot.telemetry.autopilot_version())
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

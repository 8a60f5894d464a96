"""The MAVLink endpoint of one simulated vehicle: bytes in, bytes out; the caller advances time."""

from __future__ import annotations

import io
import math
from collections.abc import Callable
from contextlib import suppress
from typing import Any

from brakeline.errors import BadParameter, RequestRefused, UnknownMode, UnknownName
from brakeline.sim.autopilot.autopilot_rules import RULES
from brakeline.sim.autopilot.common_dialect import mavlink
from brakeline.sim.autopilot.flight_modes import FlightStateMachine, Mode
from brakeline.sim.autopilot.parameters import Parameters
from brakeline.sim.autopilot.telemetry_sender import MESSAGES, StreamSchedule, TelemetryBuilder
from brakeline.sim.quadrotor import Quadrotor

TICK = 0.02  # s between two updates of modes, timeouts and streams; the flight controller runs faster
HEARTBEAT = mavlink.MAVLINK_MSG_ID_HEARTBEAT
FORCED = 21196.0  # param2 of an arming command that skips all checks
ACCEPTED, DENIED = int(mavlink.MAV_RESULT_ACCEPTED), int(mavlink.MAV_RESULT_DENIED)
UNSUPPORTED = int(mavlink.MAV_RESULT_UNSUPPORTED)


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
        quiet: bool = False,
    ) -> None:
        """Connect the autopilot to a vehicle.

        Args:
            rules: `px4` or `ardupilot`.
            system: MAVLink system id.
            parameters: values that replace the defaults.
            quiet: send only the heartbeat, and messages on request.

        Raises:
            UnknownName: no rule set has this name.
            BadParameter: a parameter does not exist, or cannot have this value.
        """
        if rules not in RULES:
            raise UnknownName(f"no rule set is called {rules!r}; there are: {', '.join(RULES)}")
        self.vehicle, self.rules = vehicle, RULES[rules]
        self.parameters = Parameters(self.rules.parameters, self.rules.bitwise_integers)
        for name, value in (parameters or {}).items():
            self.parameters.set(name, value)
        self.flight = FlightStateMachine(vehicle, self.rules.limits(self.parameters), self.rules.initial_mode)
        self.telemetry = TelemetryBuilder(self.flight)
        self._ticks = round(TICK / vehicle.timestep)
        self._send_buffer = io.BytesIO()
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
            handler = getattr(self, f"_on_{message.get_type().lower()}", None)
            if handler is not None and self._for_me(message):
                handler(message)

    def take(self) -> bytes:
        """Return the bytes to send since the last call."""
        data = self._send_buffer.getvalue()
        self._send_buffer.seek(0)
        self._send_buffer.truncate()
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
                else:
                    send(self.telemetry.build(kind))

    def can_send(self, kind: int) -> bool:
        """Return whether the autopilot knows this message."""
        return kind == HEARTBEAT or (kind in MESSAGES and kind not in self.rules.unsupported)

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

    # `receive` calls the method `_on_` + name of the message.

    def _on_set_position_target_local_ned(self, message: Any) -> None:
        try:
            self.rules.setpoint(self.flight, message, self.telemetry.heading())
        except RequestRefused as refusal:
            self.send_text(str(refusal), mavlink.MAV_SEVERITY_CRITICAL)

    def _on_command_long(self, message: Any) -> None:
        m = message
        self._command(m, m.param1, m.param2, m.param3, m.param7, mavlink.MAV_FRAME_GLOBAL_RELATIVE_ALT)

    def _on_command_int(self, message: Any) -> None:
        m = message
        self._command(m, m.param1, m.param2, m.param3, m.z, m.frame)

    def _command(self, message: Any, *params: float) -> None:
        """Carry out a command and acknowledge it. params: 1, 2, 3 and 7, and the MAV_FRAME of the last."""
        action = ACTIONS.get(message.command)
        try:
            result = mavlink.MAV_RESULT_UNSUPPORTED if action is None else action(self, *params)
        except RequestRefused as refusal:
            unknown = isinstance(refusal, UnknownMode)
            result = mavlink.MAV_RESULT_UNSUPPORTED if unknown else self.rules.refusal
            self.send_text(str(refusal))
        self.mav.command_ack_send(message.command, result, 0, 0, message.get_srcSystem(), message.get_srcComponent())
        self._send_announcements()

    def _on_set_mode(self, message: Any) -> None:
        try:
            if message.base_mode & mavlink.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED:
                self.rules.change(self.flight, message.custom_mode)
        except RequestRefused as refusal:
            self.send_text(str(refusal))

    def _on_request_data_stream(self, message: Any) -> None:
        for kind in self.rules.stream_groups.get(message.req_stream_id, ()):
            rate = message.req_message_rate if message.start_stop else 0
            self.schedule.set(kind, 1.0 / rate if rate else 0.0, self.flight.time)

    def _on_param_request_list(self, _: Any) -> None:
        for index in range(len(self.parameters.table)):
            self.mav.send(self.parameters.message(index))

    def _on_param_request_read(self, message: Any) -> None:
        parameters = self.parameters
        try:
            index = message.param_index if message.param_index >= 0 else parameters.index(message.param_id)
            self.mav.send(parameters.message(index))
        except (BadParameter, IndexError):
            self.send_text(f"unknown parameter {message.param_id or message.param_index}")

    def _on_param_set(self, message: Any) -> None:
        """Set a parameter, and answer with its value: the new one, or the old one if the new one is refused."""
        parameters, name = self.parameters, message.param_id
        try:
            parameters.set(name, parameters.decode(name, message.param_value, message.param_type))
            self.flight.limits = self.rules.limits(self.parameters)
        except BadParameter as error:
            self.send_text(str(error))
        with suppress(BadParameter):
            self.mav.send(parameters.message(parameters.index(name)))

    def _on_timesync(self, message: Any) -> None:
        if message.tc1 == 0:
            self.mav.timesync_send(round(1e9 * self.flight.time), message.ts1)

    # `ACTIONS` has the commands of these methods. They return a MAV_RESULT.

    def _arm_disarm(self, switch: float, force: float, *_: float) -> int:
        if switch not in (0.0, 1.0):
            return UNSUPPORTED
        if switch:
            self.rules.arm(self.flight)
        else:
            self.flight.disarm(force == FORCED)
        return ACCEPTED

    def _take_off(self, _: float, __: float, ___: float, altitude: float, frame: int) -> int:
        if self.rules.takeoff_frames is not None and frame not in self.rules.takeoff_frames:
            return DENIED
        self.rules.take_off(self.flight, altitude)
        return ACCEPTED

    def _land(self, *_: float) -> int:
        self.flight.change(Mode.LAND)
        return ACCEPTED

    def _set_mode(self, *params: float) -> int:
        base, main, sub = (round(p) if math.isfinite(p) else 0 for p in params[:3])
        if not base & mavlink.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED:
            return DENIED
        self.rules.change(self.flight, self.rules.mode_number(main, sub))
        return ACCEPTED

    def _set_interval(self, kind: float, microseconds: float, *_: float) -> int:
        """Set the interval of a message [µs]: 0 for the default rate, -1 to stop."""
        kind, rates = _whole(kind), self.rules.rates
        if not self.can_send(kind):
            self.send_text(f"message {kind} is not known")
            return int(mavlink.MAV_RESULT_FAILED)
        if not math.isfinite(microseconds):
            return DENIED
        interval = 1e-6 * microseconds
        if microseconds == 0.0:
            interval = 1.0 / rates[kind] if kind in rates else 0.0
        elif 0.0 < interval < TICK - 1e-9:
            interval = TICK
        self.schedule.set(kind, interval, self.flight.time)
        return ACCEPTED

    def _get_interval(self, kind: float, *_: float) -> int:
        kind = _whole(kind)
        if not self.can_send(kind):
            return DENIED
        interval = self.schedule.interval(kind)
        self.mav.message_interval_send(kind, round(1e6 * interval) if interval else -1)
        return ACCEPTED

    def _request_message(self, kind: float, *_: float) -> int:
        kind = _whole(kind)
        if kind == HEARTBEAT or not self.can_send(kind):
            return UNSUPPORTED
        self.mav.send(self.telemetry.build(kind))
        return ACCEPTED


def _whole(number: float) -> int:
    """Return a number in a command as an integer; -1, which is no message, if it is not finite."""
    return round(number) if math.isfinite(number) else -1


ACTIONS: dict[int, Callable[..., int]] = {
    mavlink.MAV_CMD_COMPONENT_ARM_DISARM: Autopilot._arm_disarm,
    mavlink.MAV_CMD_NAV_TAKEOFF: Autopilot._take_off,
    mavlink.MAV_CMD_NAV_LAND: Autopilot._land,
    mavlink.MAV_CMD_DO_SET_MODE: Autopilot._set_mode,
    mavlink.MAV_CMD_SET_MESSAGE_INTERVAL: Autopilot._set_interval,
    mavlink.MAV_CMD_GET_MESSAGE_INTERVAL: Autopilot._get_interval,
    mavlink.MAV_CMD_REQUEST_MESSAGE: Autopilot._request_message,
}

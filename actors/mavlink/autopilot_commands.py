"""Commands to one autopilot over MAVLink 2; its heartbeat says which kind it is.

The frame NED ends here: every argument is in ENU and SI units. The client has no thread, no clock and no socket. It
passes bytes to `send`, and the caller passes a function that waits.
"""

from __future__ import annotations

import contextlib
import struct
from collections.abc import Callable

import numpy as np

from brakeline.actors.mavlink.ardupilot_dialect import mavlink
from brakeline.actors.mavlink.mavlink_decoder import AUTOPILOT, OFFBOARD, MavlinkDecoder
from brakeline.actors.mavlink.position_lookahead import MASK, PARAMETERS, PositionLookahead
from brakeline.actors.mavlink.telemetry import ESTIMATORS, SOURCES, Array
from brakeline.errors import CommandRefused, MavlinkError, NoAutopilot, TelemetryMissing

HEARTBEAT_INTERVAL = 1.0  # s between two of our heartbeats, as autopilots expect
VELOCITY_ONLY = 0x0DC7  # type mask: ignore position, acceleration, yaw and yaw rate
REPLY_TIMEOUT = 0.5  # s for a reply, before the message is sent again
COMMAND_ATTEMPTS = 5
PARAMETER_ATTEMPTS = 3
ARMING_ATTEMPTS = 120  # the autopilot refuses until its estimate is good
FIRST_MESSAGE_TIMEOUT = 1.0  # s from a grant to the first message
RATE_WINDOW = 0.5  # s in which the rate of a message is measured, at least
RATE_ATTEMPTS = 3  # measurements of a low rate, since this process may have stalled
GOOD_RATE = 0.6  # share of the requested rate with which a message is good
LEAST_RATE = 10.0  # Hz, below which flying is impossible
RESULTS = {
    value: entry.name.removeprefix("MAV_RESULT_").lower() for value, entry in mavlink.enums["MAV_RESULT"].items()
}

Wait = Callable[[Callable[[], bool], float], bool]  # (condition, timeout in s) -> whether the condition holds


class AutopilotClient(MavlinkDecoder):
    """Commands to an autopilot, on top of the values that it sends (see `MavlinkDecoder`)."""

    lookahead: PositionLookahead | None = None  # computes positions from setpoints; None: the client sends velocities

    def choose(self, what: str, interval: float, wait: Wait) -> str:
        """Choose the message that carries a quantity, and request it at an interval [s].

        The client requests one message after the other, the best one first. A message counts once it arrives at the
        requested rate; a grant alone does not count. Returns a line about the choice for the log. Raises
        TelemetryMissing: with the result of each request.
        """
        kind, tried, rates = self.identify(wait), [], dict[str, float]()
        for source in SOURCES[what]:
            if kind not in source.kinds:
                continue
            self.chosen[what] = name = source.message
            try:
                self.stream(message_id(name), interval, wait)
            except CommandRefused:
                tried.append(f"{name} is refused")
                continue
            rates[name] = self._rate(what, wait, interval)
            if rates[name] * interval >= GOOD_RATE:
                break
            tried.append(
                f"{name} arrives at {rates[name]:.0f} Hz" if rates[name] else f"{name} is granted, but never arrives"
            )
        best = max(rates, key=lambda name: rates[name], default="")
        if not best or rates[best] < min(LEAST_RATE, GOOD_RATE / interval):
            del self.chosen[what]
            raise TelemetryMissing(f"the autopilot does not send its {what}: {', '.join(tried)}")
        self.chosen[what] = best
        for name in rates.keys() - set(self.chosen.values()):
            with contextlib.suppress(CommandRefused):
                self.stream(message_id(name), 0.0, wait)
        return f"{what} from {best} at {rates[best]:.0f} Hz" + (f" ({', '.join(tried)})" if tried else "")

    def watch_estimator(self, wait: Wait) -> bool:
        """Request the estimator's state. Return False if the autopilot refuses; a message may take a while to come."""
        for name in ESTIMATORS:
            try:
                self.stream(message_id(name), 0.5, wait)
            except CommandRefused:
                continue
            return True
        return False

    def parameter(self, name: str, wait: Wait) -> float | None:
        """Return a parameter's value; None if the autopilot does not have it, or does not answer."""
        self._parameters.pop(name, None)
        for _ in range(PARAMETER_ATTEMPTS):
            self._mav.param_request_read_send(self.system, AUTOPILOT, name.encode(), -1)
            if wait(lambda: name in self._parameters, REPLY_TIMEOUT):
                return self._parameters[name]
        return None

    def set_parameter(self, name: str, value: float, wait: Wait) -> bool:
        """Set a parameter that the autopilot has. Return whether it then has that value."""
        if self.parameter(name, wait) is None:
            return False
        type, sent = self._types[name], value
        if self.kind == "px4" and type == mavlink.MAV_PARAM_TYPE_INT32:  # as the bits of the integer
            sent = struct.unpack("<f", struct.pack("<i", round(value)))[0]
        for _ in range(PARAMETER_ATTEMPTS):
            self._parameters.pop(name, None)
            self._mav.param_set_send(self.system, AUTOPILOT, name.encode(), sent, type)
            if wait(lambda: name in self._parameters, REPLY_TIMEOUT) and abs(self._parameters[name] - value) < 0.01:
                return True
        return False

    def ask_time(self, now: int) -> None:
        """Request the autopilot's clock by TIMESYNC; now: our clock, ns. The reply goes to `clock_answers`."""
        self._mav.timesync_send(0, now)

    def heartbeat(self) -> None:
        """Send our heartbeat; an autopilot expects one every `HEARTBEAT_INTERVAL`."""
        self._mav.heartbeat_send(
            mavlink.MAV_TYPE_ONBOARD_CONTROLLER, mavlink.MAV_AUTOPILOT_INVALID, 0, 0, mavlink.MAV_STATE_ACTIVE
        )

    def setpoint(self, velocity: Array) -> None:
        """Send a velocity setpoint (3,) [m/s, ENU], or the position that makes the vehicle fly it."""
        if self.lookahead is not None and self.position is not None:
            x, y, z = self.lookahead.target(self.position, self.velocity, velocity).tolist()
            mask, target = MASK, (y, x, -z, 0.0, 0.0, 0.0)
        else:
            east, north, up = velocity.tolist()
            mask, target = VELOCITY_ONLY, (0.0, 0.0, 0.0, north, east, -up)
        self._mav.set_position_target_local_ned_send(
            round(1e3 * self.time), self.system, AUTOPILOT, mavlink.MAV_FRAME_LOCAL_NED, mask,
            *target, 0.0, 0.0, 0.0, 0.0, 0.0,
        )  # fmt: skip

    def lead(self, wait: Wait) -> None:
        """Send positions from now on. Raises MavlinkError: the parameters of its position controller are unknown."""
        kind = self.identify(wait)
        replies = {name: self.parameter(name, wait) for name in PARAMETERS[kind]}
        values = {name: value for name, value in replies.items() if value is not None}
        if missing := replies.keys() - values.keys():
            raise MavlinkError(
                f"the autopilot has no {', '.join(sorted(missing))}: fly it by velocities, without --lead"
            )
        try:
            self.lookahead = PositionLookahead.of(kind, values)
        except ValueError as error:
            raise MavlinkError(f"the autopilot cannot be flown by positions: {error}") from error

    def command(self, number: int, *params: float, wait: Wait) -> None:
        """Send COMMAND_LONG until the autopilot accepts it. Raises CommandRefused: with its result and latest texts."""
        filled = (*params, *[0.0] * (7 - len(params)))
        result = None
        for attempt in range(COMMAND_ATTEMPTS):
            self._acks.pop(number, None)
            self._mav.command_long_send(self.system, AUTOPILOT, number, attempt, *filled)
            if not wait(lambda: number in self._acks, REPLY_TIMEOUT):
                continue
            result = self._acks[number]
            if result == mavlink.MAV_RESULT_ACCEPTED:
                return
            if result != mavlink.MAV_RESULT_TEMPORARILY_REJECTED:
                break
            wait(lambda: False, REPLY_TIMEOUT)
        answer = "no answer" if result is None else RESULTS.get(result, str(result))
        name = mavlink.enums["MAV_CMD"][number].name
        raise CommandRefused(
            f"{name}: {answer}{'; the autopilot says: ' + '; '.join(self.texts[-3:]) if self.texts else ''}"
        )

    def stream(self, kind: int, interval: float, wait: Wait) -> None:
        """Request a message at an interval [s]; 0: never. Raises CommandRefused."""
        microseconds = 1e6 * interval if interval > 0.0 else -1.0
        self.command(mavlink.MAV_CMD_SET_MESSAGE_INTERVAL, kind, microseconds, wait=wait)

    def request(self, kind: int, wait: Wait) -> None:
        """Request a message once. Raises CommandRefused."""
        self.command(mavlink.MAV_CMD_REQUEST_MESSAGE, kind, wait=wait)

    def identify(self, wait: Wait) -> str:
        """Wait for a heartbeat, and return `px4` or `ardupilot`. Raises NoAutopilot."""
        if not wait(lambda: self.kind is not None, 10.0):
            raise NoAutopilot(f"no heartbeat of PX4 or ArduPilot with system id {self.system} within 10 s")
        assert self.kind is not None
        return self.kind

    def follow_setpoints(self, wait: Wait) -> None:
        """Change to offboard or guided mode; PX4 needs a setpoint before. Raises CommandRefused."""
        self.setpoint(np.zeros(3))
        self.command(
            mavlink.MAV_CMD_DO_SET_MODE,
            mavlink.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED,
            OFFBOARD[self.identify(wait)][0],
            wait=wait,
        )

    def arm(self, wait: Wait) -> None:
        """Arm; the autopilot refuses until its estimate is good, for up to a minute. Raises CommandRefused."""
        for last in (*[False] * ARMING_ATTEMPTS, True):
            try:
                return self.command(mavlink.MAV_CMD_COMPONENT_ARM_DISARM, 1.0, wait=wait)
            except CommandRefused:
                if last:
                    raise
                wait(lambda: False, REPLY_TIMEOUT)

    def take_off(self, height: float, wait: Wait) -> None:
        """Take off to a height [m]: ArduPilot only, in guided mode and armed. Raises CommandRefused."""
        self.command(mavlink.MAV_CMD_NAV_TAKEOFF, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, height, wait=wait)

    def land(self, wait: Wait) -> None:
        """Land. Raises CommandRefused."""
        self.command(mavlink.MAV_CMD_NAV_LAND, wait=wait)

    def _rate(self, what: str, wait: Wait, interval: float) -> float:
        """Return the rate [Hz] at which the chosen message of a quantity arrives; 0: it does not arrive."""
        before, best = self.message_counts[what], 0.0
        if not wait(lambda: self.message_counts[what] > before, FIRST_MESSAGE_TIMEOUT):
            return best
        window = max(RATE_WINDOW, 4.0 * interval)
        for _ in range(RATE_ATTEMPTS):
            before = self.message_counts[what]
            wait(lambda: False, window)
            best = max(best, (self.message_counts[what] - before) / window)
            if best * interval >= GOOD_RATE:
                break
        return best


def message_id(name: str) -> int:
    """Return the id of a message from its name."""
    return int(getattr(mavlink, f"MAVLINK_MSG_ID_{name}"))

"""Commands to one autopilot over MAVLink 2, told apart by its heartbeat.

NED ends here; what goes in is ENU, SI units. No thread, no clock, no socket: bytes are handed to `send`, and who waits
for something brings a way of waiting.
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

VELOCITY_ONLY = 0x0DC7  # type mask: position, acceleration, yaw and yaw rate are to be ignored
ANSWER = 0.5  # s for a COMMAND_ACK, then it is sent again
TRIES = 5
ARMINGS = 120  # times that arming may be refused at first
FIRST, WATCHED = 1.0, 0.5  # s until a message that was granted comes, and for how long its rate is then watched
LOOKS = 3  # at a rate that is poor: this side may have stalled
PROMPT, SLOWEST = 0.6, 10.0  # share of the rate asked for that is good, and Hz without which nobody can fly
RESULTS = {
    value: entry.name.removeprefix("MAV_RESULT_").lower() for value, entry in mavlink.enums["MAV_RESULT"].items()
}

Wait = Callable[[Callable[[], bool], float], bool]  # until a condition holds, at most so many seconds; whether it does


class MavlinkError(RuntimeError):
    """The autopilot does not do what it is asked to."""


class NoAutopilot(MavlinkError):
    """No heartbeat of an autopilot that we know."""


class CommandRefused(MavlinkError):
    """A COMMAND_ACK with another result than accepted, or none."""


class TelemetryMissing(MavlinkError):
    """Something that is needed comes by none of the messages that could tell it."""


class AutopilotClient(MavlinkDecoder):
    """Commands to an autopilot, and what it tells: see `MavlinkDecoder`."""

    lookahead: PositionLookahead | None = None  # it is told places in place of velocities

    def choose(self, what: str, interval: float, wait: Wait) -> str:
        """Find out which message tells something, and have it sent every so many seconds: a line about it for people.

        Asked for one after the other, the best first; a grant counts for nothing until the message comes, at its rate.

        Raises:
            TelemetryMissing: with what became of each.
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
            if rates[name] * interval >= PROMPT:
                break
            tried.append(f"{name} comes at {rates[name]:.0f} Hz" if rates[name] else f"{name} is granted, never comes")
        best = max(rates, key=lambda name: rates[name], default="")
        if not best or rates[best] < min(SLOWEST, PROMPT / interval):
            del self.chosen[what]
            raise TelemetryMissing(f"it does not tell its {what}: {', '.join(tried)}")
        self.chosen[what] = best
        for name in rates.keys() - set(self.chosen.values()):
            with contextlib.suppress(CommandRefused):
                self.stream(message_id(name), 0.0, wait)
        return f"{what} from {best} at {rates[best]:.0f} Hz" + (f" ({', '.join(tried)})" if tried else "")

    def watch_estimator(self, wait: Wait) -> bool:
        """Have it tell how its estimate is; False: it will not. Just switched on it may be silent for a while."""
        for name in ESTIMATORS:
            try:
                self.stream(message_id(name), 0.5, wait)
            except CommandRefused:
                continue
            return True
        return False

    def parameter(self, name: str, wait: Wait) -> float | None:
        """A parameter's value; None: it has none of that name, or does not say."""
        self._parameters.pop(name, None)
        for _ in range(3):
            self._mav.param_request_read_send(self.system, AUTOPILOT, name.encode(), -1)
            if wait(lambda: name in self._parameters, ANSWER):
                return self._parameters[name]
        return None

    def set_parameter(self, name: str, value: float, wait: Wait) -> bool:
        """Whether it then has that value. One that it has not is not set."""
        if self.parameter(name, wait) is None:
            return False
        type, sent = self._types[name], value
        if self.kind == "px4" and type == mavlink.MAV_PARAM_TYPE_INT32:  # its bits, and of no other type
            sent = struct.unpack("<f", struct.pack("<i", round(value)))[0]
        for _ in range(3):
            self._parameters.pop(name, None)
            self._mav.param_set_send(self.system, AUTOPILOT, name.encode(), sent, type)
            if wait(lambda: name in self._parameters, ANSWER) and abs(self._parameters[name] - value) < 0.01:
                return True
        return False

    def ask_time(self, now: int) -> None:
        """TIMESYNC; now: our clock, ns. The answer goes to `answers`."""
        self._mav.timesync_send(0, now)

    def heartbeat(self) -> None:
        """We live; once a second is expected."""
        self._mav.heartbeat_send(
            mavlink.MAV_TYPE_ONBOARD_CONTROLLER, mavlink.MAV_AUTOPILOT_INVALID, 0, 0, mavlink.MAV_STATE_ACTIVE
        )

    def setpoint(self, velocity: Array) -> None:
        """Ask for a velocity (3,) [m/s], ENU."""
        if self.lookahead is not None and self.position is not None:
            x, y, z = self.lookahead.target(self.position, self.velocity, velocity).tolist()
            mask, told = MASK, (y, x, -z, 0.0, 0.0, 0.0)
        else:
            east, north, up = velocity.tolist()
            mask, told = VELOCITY_ONLY, (0.0, 0.0, 0.0, north, east, -up)
        self._mav.set_position_target_local_ned_send(
            round(1e3 * self.time), self.system, AUTOPILOT, mavlink.MAV_FRAME_LOCAL_NED, mask,
            *told, 0.0, 0.0, 0.0, 0.0, 0.0,
        )  # fmt: skip

    def lead(self, wait: Wait) -> None:
        """From now on tell it places. Raises MavlinkError: it does not say what it makes of them."""
        kind = self.identify(wait)
        told = {name: self.parameter(name, wait) for name in PARAMETERS[kind]}
        values = {name: value for name, value in told.items() if value is not None}
        if missing := told.keys() - values.keys():
            raise MavlinkError(
                f"it has no {', '.join(sorted(missing))}: it can only be told velocities, without --lead"
            )
        try:
            self.lookahead = PositionLookahead.of(kind, values)
        except ValueError as error:
            raise MavlinkError(f"it cannot be led to places: {error}") from error

    def command(self, number: int, *params: float, wait: Wait) -> None:
        """Send COMMAND_LONG until it is accepted.

        Raises:
            CommandRefused: with the result and what the autopilot said.
        """
        filled = (*params, *[0.0] * (7 - len(params)))
        result = None
        for attempt in range(TRIES):
            self._acks.pop(number, None)
            self._mav.command_long_send(self.system, AUTOPILOT, number, attempt, *filled)
            if not wait(lambda: number in self._acks, ANSWER):
                continue
            result = self._acks[number]
            if result == mavlink.MAV_RESULT_ACCEPTED:
                return
            if result != mavlink.MAV_RESULT_TEMPORARILY_REJECTED:
                break
            wait(lambda: False, ANSWER)
        answer = "no answer" if result is None else RESULTS.get(result, str(result))
        name = mavlink.enums["MAV_CMD"][number].name
        raise CommandRefused(f"{name}: {answer}{'; it says: ' + '; '.join(self.texts[-3:]) if self.texts else ''}")

    def stream(self, kind: int, interval: float, wait: Wait) -> None:
        """Have a message sent every so many seconds; 0: not at all. Raises CommandRefused."""
        microseconds = 1e6 * interval if interval > 0.0 else -1.0
        self.command(mavlink.MAV_CMD_SET_MESSAGE_INTERVAL, kind, microseconds, wait=wait)

    def request(self, kind: int, wait: Wait) -> None:
        """Have a message sent once. Raises CommandRefused."""
        self.command(mavlink.MAV_CMD_REQUEST_MESSAGE, kind, wait=wait)

    def identify(self, wait: Wait) -> str:
        """`px4` or `ardupilot`, by its heartbeat. Raises NoAutopilot."""
        if not wait(lambda: self.kind is not None, 10.0):
            raise NoAutopilot(f"no heartbeat of PX4 or ArduPilot with system id {self.system} within 10 s")
        assert self.kind is not None
        return self.kind

    def follow_setpoints(self, wait: Wait) -> None:
        """Setpoints first, then the mode: offboard or guided. Raises CommandRefused."""
        self.setpoint(np.zeros(3))
        self.command(
            mavlink.MAV_CMD_DO_SET_MODE,
            mavlink.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED,
            OFFBOARD[self.identify(wait)][0],
            wait=wait,
        )

    def arm(self, wait: Wait) -> None:
        """Both kinds refuse until their estimate is good: ask for a while. Raises CommandRefused."""
        for last in (*[False] * ARMINGS, True):
            try:
                return self.command(mavlink.MAV_CMD_COMPONENT_ARM_DISARM, 1.0, wait=wait)
            except CommandRefused:
                if last:
                    raise
                wait(lambda: False, ANSWER)

    def take_off(self, height: float, wait: Wait) -> None:
        """ArduPilot's way off the ground, once guided and armed. Raises CommandRefused."""
        self.command(mavlink.MAV_CMD_NAV_TAKEOFF, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, height, wait=wait)

    def land(self, wait: Wait) -> None:
        """Raises CommandRefused."""
        self.command(mavlink.MAV_CMD_NAV_LAND, wait=wait)

    def _rate(self, what: str, wait: Wait, interval: float) -> float:
        """Hz at which the message chosen for it comes, once it does; 0: it does not."""
        began, best = self.message_counts[what], 0.0
        if not wait(lambda: self.message_counts[what] > began, FIRST):
            return best
        time = max(WATCHED, 4.0 * interval)
        for _ in range(LOOKS):
            began = self.message_counts[what]
            wait(lambda: False, time)
            best = max(best, (self.message_counts[what] - began) / time)
            if best * interval >= PROMPT:
                break
        return best


def message_id(name: str) -> int:
    """Of a message by its name."""
    return int(getattr(mavlink, f"MAVLINK_MSG_ID_{name}"))

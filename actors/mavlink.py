"""MAVLink 2 from the actor's side: one autopilot, told apart by its heartbeat, commanded, listened to.

NED and forward-right-down end here; what goes in and comes out is ENU, SI units. No thread, no clock, no socket: bytes
are fed in, bytes are handed to `send`, and who waits for something brings a way of waiting.
"""

from __future__ import annotations

import contextlib
import os
import struct
from collections import Counter, deque
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

os.environ.setdefault("MAVLINK20", "1")  # read when pymavlink is imported

from pymavlink.dialects.v20 import ardupilotmega as mavlink  # `common`, and what ArduPilot adds

from actors import telemetry
from actors.frames import Frame, Tap
from actors.telemetry import (
    ATTITUDE,
    ESTIMATORS,
    FORCE,
    GRAVITY,
    LANDED,
    MOTION,
    SOURCES,
    TRUTH,
    Array,
    Motion,
    Place,
)

STATION, COMPONENT = 245, int(mavlink.MAV_COMP_ID_ONBOARD_COMPUTER)  # who we are
AUTOPILOT = int(mavlink.MAV_COMP_ID_AUTOPILOT1)
VELOCITY_ONLY = 0x0DC7  # type mask: position, acceleration, yaw and yaw rate are to be ignored
ANSWER = 0.5  # s for a COMMAND_ACK, then it is sent again
TRIES = 5
ARMINGS = 120  # times that arming may be refused at first
FIRST, WATCHED = 1.0, 0.5  # s until a message that was granted comes, and for how long its rate is then watched
PROMPT, SLOWEST = 0.6, 10.0  # share of the rate asked for that is good, and Hz without which nobody can fly
FULL = 100.0  # %
KINDS = {int(mavlink.MAV_AUTOPILOT_PX4): "px4", int(mavlink.MAV_AUTOPILOT_ARDUPILOTMEGA): "ardupilot"}
OFFBOARD = {"px4": (6, 6 << 16), "ardupilot": (4, 4)}  # DO_SET_MODE's param2, and HEARTBEAT's custom mode
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


class NotTold(MavlinkError):
    """Something that is needed comes by none of the messages that could tell it."""


class Client:
    """What is known of one autopilot, and the messages to it.

    path: (time [s since its boot], position (3,)) of each position since it was last emptied; the rest is the latest.
    `position`, `velocity` [m, m/s] are (3,) or None before the first; `acceleration` [m/s²] is the accelerometer's
    reading turned into the world by the attitude, gravity taken out: few autopilots tell it themselves. Until `choose`
    has found out what comes, everything is taken from the best message that did.

    received, missed: frames of the autopilot, by their sequence numbers.
    """

    def __init__(
        self,
        send: Callable[[bytes], object],
        system: int = 1,
        tap: Tap | None = None,
        say: Callable[[str], object] | None = None,
    ) -> None:
        """system: the autopilot's; tap: is called with every frame from it and to it; say: with its texts."""
        self.system = system
        self.kind: str | None = None
        self.armed = False
        self.custom_mode = 0
        self.emergency = False
        self.airborne: bool | None = None  # None: it has not said
        self.heard: Counter[str] = Counter()  # messages by what they told: a key of SOURCES; heartbeats: "mode"
        self.time = 0.0  # s since its boot, of the latest position
        self.position: Array | None = None
        self.velocity = np.zeros(3)
        self.path: list[tuple[float, Array]] = []
        self.truth: Place | None = None  # by a simulator inside it
        self.texts: list[str] = []
        self.estimator: int | None = None  # flags, see telemetry.ESTIMATED
        self.battery: float | None = None  # %, if it tells
        self.answers: list[tuple[int, int]] = []  # ns, of TIMESYNC: what we sent, and the autopilot's clock then
        self.chosen: dict[str, str] = {}  # message by key of SOURCES
        self.received = self.missed = 0
        self._sequence: int | None = None
        self._came: Counter[str] = Counter()  # messages by name
        self._best: dict[str, int] = {}  # place in SOURCES of the best message that came, until one is chosen
        self._attitude: telemetry.Quaternion = (1.0, 0.0, 0.0, 0.0)  # NED from forward-right-down
        self._forces: deque[telemetry.Triple] = deque([(0.0, 0.0, -GRAVITY)], 1)
        self._acks: dict[int, int] = {}
        self._parameters: dict[str, float] = {}
        self._tap, self._say = tap, say
        self._mav = mavlink.MAVLink(_Pipe(send), srcSystem=STATION, srcComponent=COMPONENT)
        self._mav.robust_parsing = True
        if tap is not None:
            self._mav.set_send_callback(lambda message: tap(Frame(True, bytes(message.get_msgbuf()), message)))

    @property
    def acceleration(self) -> Array:
        """(3,) m/s², ENU."""
        count = len(self._forces)
        x, y, z = (sum(force[axis] for force in self._forces) / count for axis in range(3))
        return telemetry.acceleration(self._attitude, (x, y, z))

    @property
    def offboard(self) -> bool:
        """It follows setpoints, by its last heartbeat."""
        return self.kind is not None and self.custom_mode == OFFBOARD[self.kind][1]

    @property
    def mode(self) -> str:
        """As people call it, by its last heartbeat."""
        return "no mode yet" if self.kind is None else telemetry.mode_name(self.kind, self.custom_mode)

    def feed(self, data: bytes) -> None:
        """Bytes from the link, in pieces of any size."""
        for message in self._mav.parse_buffer(data) or ():
            if message.get_srcSystem() != self.system or message.get_srcComponent() != AUTOPILOT:
                continue
            self._count(message.get_seq())
            if self._tap is not None:
                self._tap(Frame(False, bytes(message.get_msgbuf()), message))
            name = message.get_type()
            self._came[name] += 1
            for what, place in SENDERS.get(name, ()):
                self._take(what, place, message)
            handler = HANDLERS.get(message.get_msgId())
            if handler is not None:
                handler(self, message)

    def choose(self, what: str, interval: float, wait: Wait) -> str:
        """Find out which message tells something, and have it sent every so many seconds: a line about it for people.

        Asked for one after the other, the best first; a grant counts for nothing until the message comes, at its rate.

        Raises:
            NotTold: with what became of each.
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
            rates[name] = self._rate(what, wait)
            if rates[name] * interval >= PROMPT:
                break
            tried.append(f"{name} comes at {rates[name]:.0f} Hz" if rates[name] else f"{name} is granted, never comes")
        best = max(rates, key=lambda name: rates[name], default="")
        if not best or rates[best] < min(SLOWEST, PROMPT / interval):
            del self.chosen[what]
            raise NotTold(f"it does not tell its {what}: {', '.join(tried)}")
        self.chosen[what] = best
        for name in rates.keys() - set(self.chosen.values()):
            with contextlib.suppress(CommandRefused):
                self.stream(message_id(name), 0.0, wait)
        return f"{what} from {best} at {rates[best]:.0f} Hz" + (f" ({', '.join(tried)})" if tried else "")

    def smooth(self, readings: int) -> None:
        """From now on the mean of so many readings of the accelerometer counts."""
        self._forces = deque(self._forces, readings)

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
        """Whether it then has that value."""
        for _ in range(3):
            self._parameters.pop(name, None)
            self._mav.param_set_send(self.system, AUTOPILOT, name.encode(), value, mavlink.MAV_PARAM_TYPE_REAL32)
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
        east, north, up = velocity.tolist()
        self._mav.set_position_target_local_ned_send(
            round(1e3 * self.time), self.system, AUTOPILOT, mavlink.MAV_FRAME_LOCAL_NED, VELOCITY_ONLY,
            0.0, 0.0, 0.0, north, east, -up, 0.0, 0.0, 0.0, 0.0, 0.0,
        )  # fmt: skip

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

    def _count(self, sequence: int) -> None:
        if self._sequence is not None:
            self.missed += (sequence - self._sequence - 1) % 256
        self._sequence = sequence
        self.received += 1

    def _rate(self, what: str, wait: Wait) -> float:
        """Hz at which the message chosen for it comes, once it does; 0: it does not."""
        began = self.heard[what]
        if not wait(lambda: self.heard[what] > began, FIRST):
            return 0.0
        began = self.heard[what]
        wait(lambda: False, WATCHED)
        return (self.heard[what] - began) / WATCHED

    def _take(self, what: str, place: int, message: Any) -> None:
        """What a message says of something, unless another is relied on for that."""
        source = SOURCES[what][place]
        if self.kind is not None and self.kind not in source.kinds:
            return
        chosen = self.chosen.get(what)
        if (chosen or source.message) != source.message or (not chosen and place > self._best.get(what, place)):
            return
        told = source.read(message)
        if told is None:
            return
        self._best[what] = place
        self.heard[what] += 1
        TAKERS[what](self, told)

    def _move(self, motion: Motion) -> None:
        self.time, self.position, self.velocity = motion.time, motion.position, motion.velocity
        self.path.append((motion.time, motion.position))

    def _turn(self, attitude: telemetry.Quaternion) -> None:
        self._attitude = attitude

    def _feel(self, force: telemetry.Triple) -> None:
        self._forces.append(force)

    def _lift(self, airborne: bool) -> None:
        self.airborne = airborne

    def _witness(self, place: Place) -> None:
        self.truth = place

    def _on_heartbeat(self, message: Any) -> None:
        if message.autopilot not in KINDS:
            return
        self.kind = KINDS[message.autopilot]
        self.armed = bool(message.base_mode & mavlink.MAV_MODE_FLAG_SAFETY_ARMED)
        self.emergency = message.system_status in (mavlink.MAV_STATE_CRITICAL, mavlink.MAV_STATE_EMERGENCY)
        self.custom_mode = message.custom_mode
        self.heard["mode"] += 1

    def _on_ack(self, message: Any) -> None:
        if message.result != mavlink.MAV_RESULT_IN_PROGRESS:
            self._acks[message.command] = message.result

    def _on_text(self, message: Any) -> None:
        fresh = not self.texts or self.texts[-1] != message.text
        self.texts.append(message.text)
        if fresh and self._say is not None:
            self._say(message.text)

    def _on_estimator(self, message: Any) -> None:
        self.estimator = message.flags

    def _on_status(self, message: Any) -> None:
        if 0 <= message.battery_remaining <= FULL:
            self.battery = float(message.battery_remaining)

    def _on_parameter(self, message: Any) -> None:
        value = message.param_value
        if self.kind == "px4" and message.param_type == mavlink.MAV_PARAM_TYPE_INT32:  # its bits, not its value
            value = struct.unpack("<i", struct.pack("<f", value))[0]
        self._parameters[message.param_id] = float(value)

    def _on_time(self, message: Any) -> None:
        if message.tc1 == 0:
            return  # it asks: its own estimate of our clock is of no use to what we send
        self.answers.append((message.ts1, message.tc1))


HANDLERS: dict[int, Callable[[Client, Any], None]] = {
    mavlink.MAVLINK_MSG_ID_HEARTBEAT: Client._on_heartbeat,
    mavlink.MAVLINK_MSG_ID_COMMAND_ACK: Client._on_ack,
    mavlink.MAVLINK_MSG_ID_STATUSTEXT: Client._on_text,
    mavlink.MAVLINK_MSG_ID_EKF_STATUS_REPORT: Client._on_estimator,
    mavlink.MAVLINK_MSG_ID_ESTIMATOR_STATUS: Client._on_estimator,
    mavlink.MAVLINK_MSG_ID_SYS_STATUS: Client._on_status,
    mavlink.MAVLINK_MSG_ID_PARAM_VALUE: Client._on_parameter,
    mavlink.MAVLINK_MSG_ID_TIMESYNC: Client._on_time,
}
TAKERS: dict[str, Callable[[Client, Any], None]] = {
    MOTION: Client._move,
    ATTITUDE: Client._turn,
    FORCE: Client._feel,
    LANDED: Client._lift,
    TRUTH: Client._witness,
}
SENDERS: dict[str, list[tuple[str, int]]] = {}  # by message: what it can tell, and its place there
for _what, _sources in SOURCES.items():
    for _place, _source in enumerate(_sources):
        SENDERS.setdefault(_source.message, []).append((_what, _place))


def message_id(name: str) -> int:
    """Of a message by its name."""
    return int(getattr(mavlink, f"MAVLINK_MSG_ID_{name}"))


@dataclass(frozen=True)
class _Pipe:
    """What pymavlink takes for a file."""

    write: Callable[[bytes], object]

"""What an autopilot tells: its MAVLink 2 messages, read.

NED and forward-right-down end here; what comes out is ENU, SI units. Bytes are fed in: no thread, no clock, no socket.
"""

from __future__ import annotations

import struct
from collections import Counter, deque
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from actors import telemetry
from actors.dialect import mavlink
from actors.frames import Frame, Tap
from actors.telemetry import ATTITUDE, FORCE, GRAVITY, LANDED, MOTION, SOURCES, TRUTH, Array, Motion, Place

STATION, COMPONENT = 245, int(mavlink.MAV_COMP_ID_ONBOARD_COMPUTER)  # who we are
AUTOPILOT = int(mavlink.MAV_COMP_ID_AUTOPILOT1)
FULL = 100.0  # %
KINDS = {int(mavlink.MAV_AUTOPILOT_PX4): "px4", int(mavlink.MAV_AUTOPILOT_ARDUPILOTMEGA): "ardupilot"}
SIDES = {1: "least altitude", 2: "greatest altitude", 3: "boundary"}  # FENCE_BREACH
OFFBOARD = {"px4": (6, 6 << 16), "ardupilot": (4, 4)}  # DO_SET_MODE's param2, and HEARTBEAT's custom mode


class Heard:
    """What is known of one autopilot, from its messages.

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
        self.outside = ""  # of its geofence: over which side; empty: it has not said that it is
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
        self._types: dict[str, int] = {}  # MAV_PARAM_TYPE of each of them
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

    def smooth(self, readings: int) -> None:
        """From now on the mean of so many readings of the accelerometer counts."""
        self._forces = deque(self._forces, readings)

    def _count(self, sequence: int) -> None:
        if self._sequence is not None:
            self.missed += (sequence - self._sequence - 1) % 256
        self._sequence = sequence
        self.received += 1

    def _take(self, what: str, place: int, message: Any) -> None:
        """What a message says of something, unless another is relied on for that."""
        source = SOURCES[what][place]
        if self.kind is not None and self.kind not in source.kinds:
            return
        chosen = self.chosen.get(what)
        if (chosen or source.message) != source.message or (not chosen and place > self._best.get(what, place)):
            return
        told = telemetry.told(source, message)
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

    def _on_fence(self, message: Any) -> None:
        side = SIDES.get(message.breach_type, "") or "geofence"
        self.outside = side if message.breach_status else ""

    def _on_parameter(self, message: Any) -> None:
        value = message.param_value
        if self.kind == "px4" and message.param_type == mavlink.MAV_PARAM_TYPE_INT32:  # its bits, not its value
            value = struct.unpack("<i", struct.pack("<f", value))[0]
        self._parameters[message.param_id], self._types[message.param_id] = float(value), message.param_type

    def _on_time(self, message: Any) -> None:
        if message.tc1 == 0:
            return  # it asks: its own estimate of our clock is of no use to what we send
        self.answers.append((message.ts1, message.tc1))


HANDLERS: dict[int, Callable[[Heard, Any], None]] = {
    mavlink.MAVLINK_MSG_ID_HEARTBEAT: Heard._on_heartbeat,
    mavlink.MAVLINK_MSG_ID_COMMAND_ACK: Heard._on_ack,
    mavlink.MAVLINK_MSG_ID_STATUSTEXT: Heard._on_text,
    mavlink.MAVLINK_MSG_ID_EKF_STATUS_REPORT: Heard._on_estimator,
    mavlink.MAVLINK_MSG_ID_ESTIMATOR_STATUS: Heard._on_estimator,
    mavlink.MAVLINK_MSG_ID_SYS_STATUS: Heard._on_status,
    mavlink.MAVLINK_MSG_ID_FENCE_STATUS: Heard._on_fence,
    mavlink.MAVLINK_MSG_ID_PARAM_VALUE: Heard._on_parameter,
    mavlink.MAVLINK_MSG_ID_TIMESYNC: Heard._on_time,
}
TAKERS: dict[str, Callable[[Heard, Any], None]] = {
    MOTION: Heard._move,
    ATTITUDE: Heard._turn,
    FORCE: Heard._feel,
    LANDED: Heard._lift,
    TRUTH: Heard._witness,
}
SENDERS: dict[str, list[tuple[str, int]]] = {}  # by message: what it can tell, and its place there
for _what, _sources in SOURCES.items():
    for _place, _source in enumerate(_sources):
        SENDERS.setdefault(_source.message, []).append((_what, _place))


@dataclass(frozen=True)
class _Pipe:
    """What pymavlink takes for a file."""

    write: Callable[[bytes], object]

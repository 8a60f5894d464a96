"""Decode the MAVLink 2 messages of one autopilot.

The frames NED and forward-right-down end here: every value that comes out is in ENU and SI units. The caller feeds the
bytes; the decoder has no thread, no clock and no socket.
"""

from __future__ import annotations

import struct
from collections import Counter, deque
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import numpy as np

from brakeline.actors.mavlink import telemetry
from brakeline.actors.mavlink.ardupilot_dialect import mavlink
from brakeline.actors.mavlink.frame_log import CapturedFrame, FrameTap
from brakeline.actors.mavlink.telemetry import (
    ATTITUDE,
    FORCE,
    LANDED,
    MOTION,
    SOURCES,
    TRUTH,
    Array,
    GeoPosition,
    MotionSample,
)
from brakeline.errors import BadMessage
from brakeline.sim.flight_estimator import Quaternion, Vector

STATION, COMPONENT = 245, int(mavlink.MAV_COMP_ID_ONBOARD_COMPUTER)  # who we are
AUTOPILOT = int(mavlink.MAV_COMP_ID_AUTOPILOT1)
FULL = 100.0  # %
ARMED = int(mavlink.MAV_MODE_FLAG_SAFETY_ARMED)
MOST_TEXTS, MOST_CLOCK_ANSWERS, MOST_PARAMETERS = 50, 50, 4000  # stored ones: ArduPilot has 1,400 parameters
KINDS = {int(mavlink.MAV_AUTOPILOT_PX4): "px4", int(mavlink.MAV_AUTOPILOT_ARDUPILOTMEGA): "ardupilot"}
RESTARTED = 1.0  # s: a position that is older than the last one by more comes from an autopilot that has restarted
# m, m/s²: two positions that differ by more from their mean velocity times the time between them are no motion. With an
# acceleration up to a, the way differs from the one at the mean of the first and the last velocity by up to a t² / 4.
JUMP, JUMP_ACCELERATION = 0.5, 10.0
FENCE_SIDES = {1: "least altitude", 2: "greatest altitude", 3: "boundary"}  # FENCE_BREACH
OFFBOARD = {"px4": (6, 6 << 16), "ardupilot": (4, 4)}  # DO_SET_MODE's param2, and HEARTBEAT's custom mode


class MavlinkDecoder:
    """The latest values from one autopilot's messages.

    Until `chosen` names a message for a quantity (`AutopilotClient.choose` sets it), the decoder uses the best one that
    arrives.
    """

    def __init__(
        self,
        send: Callable[[bytes], object],
        system: int = 1,
        tap: FrameTap | None = None,
        say: Callable[[str], object] | None = None,
    ) -> None:
        """system: the autopilot's id; tap: called with each frame from it or to it; say: called with its texts."""
        self.system = system
        self.kind: str | None = None
        self.armed = False
        self.custom_mode = 0
        self.emergency = False
        # why our command of the vehicle has ended: the first reason since the caller emptied this text
        self.interruption = ""
        self.source: str | None = None  # the address of the autopilot; None before its first message
        self.second_source = ""  # another address whose messages have its system id; empty: none yet
        self.airborne: bool | None = None  # None: unknown
        self.message_counts: Counter[str] = Counter()  # by their quantity, a key of SOURCES; heartbeats are "mode"
        self.time = 0.0  # s since its boot, of the latest position
        self.position: Array | None = None  # (3,) m
        self.velocity = np.zeros(3)  # m/s
        self.path: list[tuple[float, Array]] = []  # times and positions since the caller last emptied the list
        self.truth: GeoPosition | None = None  # ground truth of the autopilot's simulator
        self.texts: list[str] = []  # the latest ones
        self.estimator: int | None = None  # flags, see telemetry.ESTIMATED
        self.battery: float | None = None  # %; None: unknown
        self.breached_side = ""  # of its geofence, that it has crossed; empty: none
        # ns, from TIMESYNC: our clock when we asked, the autopilot's then
        self.clock_answers: deque[tuple[int, int]] = deque(maxlen=MOST_CLOCK_ANSWERS)
        self.chosen: dict[str, str] = {}  # the message that a quantity is taken from, by key of SOURCES
        self._best: dict[str, int] = {}  # index in SOURCES of the best message so far, until one is chosen
        self._attitude: Quaternion = (1.0, 0.0, 0.0, 0.0)  # NED from forward-right-down
        self._forces: deque[Vector] = deque([(0.0, 0.0, -telemetry.GRAVITY)], 1)
        self._acks: dict[int, int] = {}
        self._parameters: dict[str, float] = {}
        self._types: dict[str, int] = {}  # MAV_PARAM_TYPE of each of them
        self._resets: int | None = None  # of the estimate, by ODOMETRY
        self._tap, self._say = tap, say
        self._mav = mavlink.MAVLink(SimpleNamespace(write=send), srcSystem=STATION, srcComponent=COMPONENT)
        self._mav.robust_parsing = True
        if tap is not None:
            self._mav.set_send_callback(lambda message: tap(CapturedFrame(True, bytes(message.get_msgbuf()), message)))

    @property
    def acceleration(self) -> Array:
        """The accelerometer's reading (3,) [m/s², ENU] without gravity; few autopilots send an acceleration."""
        count = len(self._forces)
        x, y, z = (sum(force[axis] for force in self._forces) / count for axis in range(3))
        return telemetry.acceleration(self._attitude, (x, y, z))

    def state(self, origin: Array | float = 0.0, ahead: float = 0.0) -> Array:
        """Return the state (9,), extrapolated by `ahead` seconds. origin: (3,) m, of the autopilot's local frame."""
        assert self.position is not None
        v, a = self.velocity, self.acceleration
        return np.concatenate((self.position + origin + ahead * v + 0.5 * ahead**2 * a, v + ahead * a, a))

    @property
    def offboard(self) -> bool:
        """Whether the autopilot follows setpoints, by its last heartbeat."""
        return self.kind is not None and self.custom_mode == OFFBOARD[self.kind][1]

    @property
    def mode(self) -> str:
        """The name of its mode, by its last heartbeat."""
        return "no mode yet" if self.kind is None else telemetry.mode_name(self.kind, self.custom_mode)

    def feed(self, data: bytes, source: str = "") -> None:
        """Decode bytes from the link, in pieces of any size.

        source: the address that they come from. Raises BadMessage: a second vehicle there has the autopilot's id.
        """
        for message in self._mav.parse_buffer(data) or ():
            if message.get_srcSystem() != self.system or message.get_srcComponent() != AUTOPILOT:
                continue
            self._check_source(source)
            if self._tap is not None:
                self._tap(CapturedFrame(False, bytes(message.get_msgbuf()), message))
            for what, place in SENDERS.get(message.get_type(), ()):
                self._take(what, place, message)
            self._handle(message)

    def average_accelerometer(self, readings: int) -> None:
        """Average this many readings of the accelerometer from now on."""
        self._forces = deque(self._forces, readings)

    def _take(self, what: str, place: int, message: Any) -> None:
        """Take the quantity `what` from a message, unless a better message provides it."""
        source = SOURCES[what][place]
        if self.kind is not None and self.kind not in source.kinds:
            return
        chosen = self.chosen.get(what)
        if (chosen or source.message) != source.message or (not chosen and place > self._best.get(what, place)):
            return
        value = telemetry.read_source(source, message)
        if value is None:
            return
        if what == MOTION and not self._newer(value):
            return
        self._best[what] = place
        self.message_counts[what] += 1
        if what == MOTION:
            self.time, self.position, self.velocity = value.time, value.position, value.velocity
            self.path.append((value.time, value.position))
        elif what == ATTITUDE:
            self._attitude = value
        elif what == FORCE:
            self._forces.append(value)
        elif what == LANDED:
            self.airborne = value
        elif what == TRUTH:
            self.truth = value

    def _handle(self, message: Any) -> None:
        """Take in a message about the autopilot itself."""
        match message.get_type():
            case "HEARTBEAT" if message.autopilot in KINDS:
                self.kind, armed = KINDS[message.autopilot], bool(message.base_mode & ARMED)
                if self.armed and not armed:
                    self._interrupt("it has disarmed")
                self.armed = armed
                # the higher states are emergencies, too: it ends its flight, or powers off
                self.emergency = message.system_status >= mavlink.MAV_STATE_CRITICAL
                self.custom_mode = message.custom_mode
                self.message_counts["mode"] += 1
            case "COMMAND_ACK" if message.result != mavlink.MAV_RESULT_IN_PROGRESS:
                self._acks[message.command] = message.result
            case "STATUSTEXT":
                if self._say is not None and self.texts[-1:] != [message.text]:
                    self._say(message.text)
                self.texts = [*self.texts[1 - MOST_TEXTS :], message.text]
            case "ODOMETRY" if message.frame_id in telemetry.LOCAL:
                if self._resets not in (None, message.reset_counter):
                    self._interrupt("its estimator has reset its position, velocity or attitude")
                self._resets = message.reset_counter
            case "EKF_STATUS_REPORT" | "ESTIMATOR_STATUS":
                self.estimator = message.flags
            case "SYS_STATUS" if 0 <= message.battery_remaining <= FULL:
                self.battery = float(message.battery_remaining)
            case "FENCE_STATUS":
                side = FENCE_SIDES.get(message.breach_type, "") or "geofence"
                self.breached_side = side if message.breach_status else ""
            case "PARAM_VALUE":
                value = message.param_value
                if self.kind == "px4" and message.param_type == mavlink.MAV_PARAM_TYPE_INT32:  # the integer's bits
                    value = struct.unpack("<i", struct.pack("<f", value))[0]
                self._note_parameter(message.param_id, float(value), message.param_type)
            case "TIMESYNC" if message.tc1 != 0:  # 0: the autopilot asks for our clock
                self.clock_answers.append((message.ts1, message.tc1))

    def _check_source(self, source: str) -> None:
        """Remember the autopilot's address. Raises BadMessage: this is another one."""
        if self.source is None:
            self.source = source
        if source != self.source:
            self.second_source = source
            raise BadMessage(self.two_sources)

    @property
    def two_sources(self) -> str:
        """Say that two vehicles have one system id, and what to do."""
        return (
            f"vehicle {self.system} is at {self.source}, and messages with its system id also come from "
            f"{self.second_source}: these are ignored. Give each vehicle on a link a system id of its own"
        )

    def _newer(self, sample: MotionSample) -> bool:
        """Return whether a position is newer than the last one, and note a restart, or a step that is no motion."""
        if self.position is None:
            return True
        duration = sample.time - self.time
        if -RESTARTED <= duration <= 0.0:
            return False
        if duration < 0.0:
            self._interrupt(
                f"it has restarted: its time since boot went from {self.time:.1f} s back to {sample.time:.1f} s"
            )
            return True
        moved = 0.5 * duration * (self.velocity + sample.velocity)
        step = float(np.linalg.norm(sample.position - self.position - moved))
        if not step <= JUMP + 0.25 * JUMP_ACCELERATION * duration**2:
            self._interrupt(f"its position jumped by {step:.2f} m within {duration:.2f} s")
        return True

    def _interrupt(self, why: str) -> None:
        self.interruption = self.interruption or why

    def _note_parameter(self, name: str, value: float, type: int) -> None:
        """Store a parameter, and forget the oldest one if there are too many."""
        self._parameters.pop(name, None)
        self._parameters[name], self._types[name] = value, type
        if len(self._parameters) > MOST_PARAMETERS:
            del self._types[oldest := next(iter(self._parameters))], self._parameters[oldest]


SENDERS: dict[str, list[tuple[str, int]]] = {}  # by message: the quantities in it, each with its index in SOURCES
for _what, _sources in SOURCES.items():
    for _place, _source in enumerate(_sources):
        SENDERS.setdefault(_source.message, []).append((_what, _place))

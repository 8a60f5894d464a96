"""MAVLink 2 from the actor's side: one autopilot, told apart by its heartbeat, commanded, listened to.

NED and forward-right-down end here; what goes in and comes out is ENU, SI units. No thread, no clock, no socket: bytes
are fed in, bytes are handed to `send`, and who waits for something brings a way of waiting.
"""

from __future__ import annotations

import math
import os
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

os.environ.setdefault("MAVLINK20", "1")  # read when pymavlink is imported

from pymavlink.dialects.v20 import common as mavlink

Array = NDArray[np.float64]

STATION, COMPONENT = 245, int(mavlink.MAV_COMP_ID_ONBOARD_COMPUTER)  # who we are
AUTOPILOT = int(mavlink.MAV_COMP_ID_AUTOPILOT1)
VELOCITY_ONLY = 0x0DC7  # type mask: position, acceleration, yaw and yaw rate are to be ignored
GRAVITY = 9.81  # m/s²
ANSWER = 0.5  # s for a COMMAND_ACK, then it is sent again
TRIES = 5
ARMINGS = 20  # times that arming may be refused at first
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


@dataclass(frozen=True)
class Frame:
    """One MAVLink frame as it was sent or received."""

    outgoing: bool
    raw: bytes
    message: Any

    @property
    def name(self) -> str:
        """Such as `mavlink/1/1/HEARTBEAT`: system, component, message."""
        m = self.message
        return f"mavlink/{m.get_srcSystem()}/{m.get_srcComponent()}/{m.get_type()}"

    @property
    def fields(self) -> dict[str, Any]:
        """For JSON: numbers that are not finite become None."""
        return {key: _plain(value) for key, value in self.message.to_dict().items()}

    @property
    def described(self) -> dict[str, Any]:
        """Header and fields, for JSON."""
        m, fields = self.message, self.fields
        header = {"system_id": m.get_srcSystem(), "component_id": m.get_srcComponent(), "sequence": m.get_seq()}
        return {"header": header, "message": {"type": fields.pop("mavpackettype"), **fields}}


Tap = Callable[[Frame], None]


def decoded(raw: bytes, outgoing: bool) -> Frame | None:
    """A frame from its bytes; None if they are none."""
    try:
        message = mavlink.MAVLink(None).decode(bytearray(raw))
    except mavlink.MAVError:
        return None
    return Frame(outgoing, raw, message)


class Client:
    """What is known of one autopilot, and the messages to it.

    path: (time [s since its boot], position (3,)) of each LOCAL_POSITION_NED since it was last emptied; the rest is the
    latest. `position`, `velocity` [m, m/s] are (3,) or None before the first; `acceleration` [m/s²] is the
    accelerometer's reading (HIGHRES_IMU) turned into the world by the attitude (ATTITUDE_QUATERNION), gravity taken
    out: all autopilots have these two, and few LOCAL_POSITION_NED_COV.
    """

    def __init__(self, send: Callable[[bytes], object], system: int = 1, tap: Tap | None = None) -> None:
        """system: the autopilot's; tap: is called with every frame from it and to it."""
        self.system = system
        self.kind: str | None = None
        self.armed = False
        self.custom_mode = 0
        self.airborne: bool | None = None  # None: it has not said
        self.heartbeats = 0
        self.time = 0.0  # s since its boot, of the latest position
        self.position: Array | None = None
        self.velocity = np.zeros(3)
        self.path: list[tuple[float, Array]] = []
        self.texts: list[str] = []
        self._attitude = (1.0, 0.0, 0.0, 0.0)  # NED from forward-right-down
        self._force = (0.0, 0.0, -GRAVITY)
        self._acks: dict[int, int] = {}
        self._tap = tap
        self._mav = mavlink.MAVLink(_Pipe(send), srcSystem=STATION, srcComponent=COMPONENT)
        self._mav.robust_parsing = True
        if tap is not None:
            self._mav.set_send_callback(lambda message: tap(Frame(True, bytes(message.get_msgbuf()), message)))

    @property
    def acceleration(self) -> Array:
        """(3,) m/s², ENU."""
        w, x, y, z = self._attitude
        a, b, c = self._force
        tx, ty, tz = 2.0 * (y * c - z * b), 2.0 * (z * a - x * c), 2.0 * (x * b - y * a)
        north, east, down = a + w * tx + y * tz - z * ty, b + w * ty + z * tx - x * tz, c + w * tz + x * ty - y * tx
        return np.array([east, north, -down - GRAVITY])

    @property
    def offboard(self) -> bool:
        """It follows setpoints, by its last heartbeat."""
        return self.kind is not None and self.custom_mode == OFFBOARD[self.kind][1]

    def feed(self, data: bytes) -> None:
        """Bytes from the link, in pieces of any size."""
        for message in self._mav.parse_buffer(data) or ():
            if message.get_srcSystem() != self.system or message.get_srcComponent() != AUTOPILOT:
                continue
            if self._tap is not None:
                self._tap(Frame(False, bytes(message.get_msgbuf()), message))
            handler = HANDLERS.get(message.get_msgId())
            if handler is not None:
                handler(self, message)

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

    def _on_heartbeat(self, message: Any) -> None:
        if message.autopilot not in KINDS:
            return
        self.kind = KINDS[message.autopilot]
        self.armed = bool(message.base_mode & mavlink.MAV_MODE_FLAG_SAFETY_ARMED)
        self.custom_mode = message.custom_mode
        self.heartbeats += 1

    def _on_position(self, message: Any) -> None:
        self.time = 1e-3 * message.time_boot_ms
        self.position = np.array([message.y, message.x, -message.z])
        self.velocity = np.array([message.vy, message.vx, -message.vz])
        self.path.append((self.time, self.position))

    def _on_attitude(self, message: Any) -> None:
        self._attitude = (message.q1, message.q2, message.q3, message.q4)

    def _on_imu(self, message: Any) -> None:
        self._force = (message.xacc, message.yacc, message.zacc)

    def _on_state(self, message: Any) -> None:
        if message.landed_state != mavlink.MAV_LANDED_STATE_UNDEFINED:
            self.airborne = message.landed_state != mavlink.MAV_LANDED_STATE_ON_GROUND

    def _on_ack(self, message: Any) -> None:
        if message.result != mavlink.MAV_RESULT_IN_PROGRESS:
            self._acks[message.command] = message.result

    def _on_text(self, message: Any) -> None:
        self.texts.append(message.text)


HANDLERS: dict[int, Callable[[Client, Any], None]] = {
    mavlink.MAVLINK_MSG_ID_HEARTBEAT: Client._on_heartbeat,
    mavlink.MAVLINK_MSG_ID_LOCAL_POSITION_NED: Client._on_position,
    mavlink.MAVLINK_MSG_ID_ATTITUDE_QUATERNION: Client._on_attitude,
    mavlink.MAVLINK_MSG_ID_HIGHRES_IMU: Client._on_imu,
    mavlink.MAVLINK_MSG_ID_EXTENDED_SYS_STATE: Client._on_state,
    mavlink.MAVLINK_MSG_ID_COMMAND_ACK: Client._on_ack,
    mavlink.MAVLINK_MSG_ID_STATUSTEXT: Client._on_text,
}

POSITION = int(mavlink.MAVLINK_MSG_ID_LOCAL_POSITION_NED)
ATTITUDE = int(mavlink.MAVLINK_MSG_ID_ATTITUDE_QUATERNION)
IMU = int(mavlink.MAVLINK_MSG_ID_HIGHRES_IMU)
STATE = int(mavlink.MAVLINK_MSG_ID_EXTENDED_SYS_STATE)


@dataclass(frozen=True)
class _Pipe:
    """What pymavlink takes for a file."""

    write: Callable[[bytes], object]


def _plain(value: Any) -> Any:
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, bytes | bytearray):
        return value.hex()
    if isinstance(value, list | tuple):
        return [_plain(inner) for inner in value]
    return value

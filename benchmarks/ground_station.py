"""A ground station that compares autopilots. It sends any message, and stores what it receives without a check."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable
from typing import Any

from brakeline.messaging.byte_links import Link
from brakeline.sim.autopilot.common_dialect import mavlink

STATION_ID = 254  # MAVLink system id
STEP = 0.02  # s between two reads of the link
STREAM = 0.05  # s between two setpoints
PATIENCE = 3.0  # s, longest wait for an answer
VELOCITY_ONLY = 0b0000_1101_1100_0111  # type mask: ignore position, acceleration, yaw and its rate
RESULTS = {value: name.removeprefix("MAV_RESULT_").lower().replace("_", " ") for name, value in vars(mavlink).items()
           if name.startswith("MAV_RESULT_") and isinstance(value, int)}  # fmt: skip


class Station:
    """Exchange messages with one vehicle.

    Attributes:
        last: the newest message of each type.
        received: the number of received messages of each type.
        velocity: the setpoint that the station streams [m/s, north, east, down]; None: it streams none.
        frame, mask: coordinate frame and type mask of the setpoints.
    """

    def __init__(self, link: Link, system: int) -> None:
        self._link, self.system = link, system
        self._mav = mavlink.MAVLink(self, srcSystem=STATION_ID, srcComponent=mavlink.MAV_COMP_ID_MISSIONPLANNER)
        self._mav.robust_parsing = True
        self.last: dict[str, Any] = {}
        self.received: Counter[str] = Counter()
        self.velocity: tuple[float, float, float] | None = None
        self.frame, self.mask = int(mavlink.MAV_FRAME_LOCAL_NED), VELOCITY_ONLY
        self._heartbeat_sent = self._setpoint_sent = -1.0

    def write(self, data: bytes) -> None:
        """Send bytes; pymavlink calls this."""
        self._link.send(bytes(data))

    def listen(self, seconds: float, until: Callable[[], object] = lambda: False) -> float:
        """Receive and stream setpoints for `seconds`, or until `until` holds. Returns the time that passed [s]."""
        started = time.monotonic()
        while (passed := time.monotonic() - started) < seconds:
            self._send_due(time.monotonic())
            for message in self._mav.parse_buffer(self._link.receive()) or ():
                if message.get_srcSystem() == self.system:
                    self.last[message.get_type()] = message
                    self.received[message.get_type()] += 1
            if until():
                break
            time.sleep(STEP)
        return passed

    def command(self, number: int, *params: float) -> str:
        """Send COMMAND_LONG. Returns its result in words; "silence" if there is none."""
        self.last.pop("COMMAND_ACK", None)
        self._mav.command_long_send(self.system, 1, number, 0, *params, *[0.0] * (7 - len(params)))

        def answered() -> bool:
            ack = self.last.get("COMMAND_ACK")
            return ack is not None and ack.command == number

        self.listen(PATIENCE, answered)
        return RESULTS.get(self.last["COMMAND_ACK"].result, "?") if answered() else "silence"

    @property
    def armed(self) -> bool:
        """Whether the last heartbeat says that the vehicle is armed."""
        beat = self.last.get("HEARTBEAT")
        return beat is not None and bool(beat.base_mode & mavlink.MAV_MODE_FLAG_SAFETY_ARMED)

    @property
    def mode(self) -> int:
        """The custom mode of the last heartbeat."""
        return int(self.last["HEARTBEAT"].custom_mode)

    def _send_due(self, now: float) -> None:
        """Send the heartbeat and the setpoint if they are due. now: monotonic time [s]."""
        if now - self._heartbeat_sent > 1.0:
            self._heartbeat_sent = now
            self._mav.heartbeat_send(mavlink.MAV_TYPE_GCS, mavlink.MAV_AUTOPILOT_INVALID, 0, 0, 0)
        if self.velocity is not None and now - self._setpoint_sent > STREAM:
            self._setpoint_sent = now
            self._mav.set_position_target_local_ned_send(
                0, self.system, 1, self.frame, self.mask, 0, 0, 0, *self.velocity, 0, 0, 0, 0, 0
            )

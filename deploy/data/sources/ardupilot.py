"""ArduPilot's own logs (.bin), and what a ground station recorded of a link (.tlog), of either autopilot.

A table a kind of message, in ENU and rad beside what the message has. Inputs are what the autopilot was told: of a
.bin a rover's desired speed and turn rate, or a copter's desired velocities; of a .tlog its setpoints.
"""

from __future__ import annotations

import math
import os
import struct
from collections import defaultdict
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

os.environ.setdefault("MAVLINK20", "1")

from pymavlink import DFReader
from pymavlink.dialects.v20 import ardupilotmega as dialect

from deploy.data.sources.angles import from_ned, yaw_from_ned
from deploy.data.sources.quantities import AXES
from deploy.data.sources.table import NoSource, Table, table_of

Row = dict[str, float]
TIME = struct.Struct(">Q")  # µs, before each frame of a .tlog
V1, V2, SIGNED = 0xFE, 0xFD, 13  # first bytes of frames; bytes of a signature
VELOCITY_IGNORED, YAW_RATE_IGNORED = 0b111000, 0x800  # in a setpoint's type mask


def _vector(kind: str, ned: tuple[float, float, float]) -> Row:
    return {f"{kind}.{axis}": value for axis, value in zip(AXES, from_ned(*ned), strict=True)}


def _body(velocity: Row, yaw: float) -> Row:
    x, y = velocity["velocity.x"], velocity["velocity.y"]
    cos, sin = math.cos(yaw), math.sin(yaw)
    return {"body.x": cos * x + sin * y, "body.y": cos * y - sin * x, "body.z": velocity["velocity.z"]}


# --- .bin ---------------------------------------------------------------------------------------------------------


def _filter(m: Any) -> Row | None:
    """The first core of the state estimator."""
    if getattr(m, "C", 0) != 0:
        return None
    velocity, yaw = _vector("velocity", (m.VN, m.VE, m.VD)), yaw_from_ned(math.radians(m.Yaw))
    return _vector("position", (m.PN, m.PE, m.PD)) | velocity | _body(velocity, yaw) | {"yaw": yaw}


def _gyroscope(m: Any) -> Row | None:
    return {"yaw rate": -m.GyrZ} if getattr(m, "I", 0) == 0 else None


BIN: dict[str, tuple[int, Callable[[Any], Row | None]]] = {
    "XKF1": (0, _filter),
    "NKF1": (1, _filter),
    "IMU": (0, _gyroscope),
    "THR": (0, lambda m: {"command.body.x": m.DesSpeed}),
    "STER": (0, lambda m: {"command.yaw rate": -math.radians(m.DesTurnRate)}),
    "PSCN": (0, lambda m: {"command.velocity.y": m.DVN}),
    "PSCE": (0, lambda m: {"command.velocity.x": m.DVE}),
    "PSCD": (0, lambda m: {"command.velocity.z": -m.DVD}),
}


def read_bin(path: Path) -> list[Table]:
    """Raises NoSource: it is no such log, or has none of the messages."""
    try:
        log = DFReader.DFReader_binary(str(path))
    except Exception as error:  # whatever pymavlink stumbles over
        raise NoSource(f"{path} is no log of ArduPilot: {error}") from error
    kept = _Kept(path, BIN)
    while (message := log.recv_match(type=list(BIN))) is not None:
        kept.take(message.get_type(), int(message.TimeUS), message)
    log.close()
    return kept.tables()


# --- .tlog --------------------------------------------------------------------------------------------------------


def _local(m: Any) -> Row:
    return _vector("position", (m.x, m.y, m.z)) | _vector("velocity", (m.vx, m.vy, m.vz))


def _setpoint(m: Any) -> Row | None:
    row: Row = {}
    if m.coordinate_frame == dialect.MAV_FRAME_LOCAL_NED and not m.type_mask & VELOCITY_IGNORED:
        row |= _vector("command.velocity", (m.vx, m.vy, m.vz))
    elif not m.type_mask & VELOCITY_IGNORED:
        row |= {"command.body.x": m.vx, "command.body.y": -m.vy, "command.body.z": -m.vz}
    return row | ({} if m.type_mask & YAW_RATE_IGNORED else {"command.yaw rate": -m.yaw_rate})


TLOG: dict[str, tuple[int, Callable[[Any], Row | None]]] = {
    "LOCAL_POSITION_NED": (0, _local),
    "ATTITUDE": (0, lambda m: {"yaw": yaw_from_ned(m.yaw), "yaw rate": -m.yawspeed}),
    "SET_POSITION_TARGET_LOCAL_NED": (0, _setpoint),
}


def read_tlog(path: Path) -> list[Table]:
    """Raises NoSource: none of the messages is in it. Bytes that are no frame are passed over."""
    kept = _Kept(path, TLOG)
    parser = dialect.MAVLink(None)
    parser.robust_parsing = True
    for micros, frame in _frames(path.read_bytes()):
        for message in parser.parse_buffer(frame) or ():
            if message.get_type() in TLOG:
                kept.take(message.get_type(), micros, message)
    return kept.tables()


def _frames(data: bytes) -> Iterator[tuple[int, bytes]]:
    at = 0
    while at + TIME.size + 3 <= len(data):
        start = at + TIME.size
        first, length, flags = data[start : start + 3]
        if first not in (V1, V2):
            at += 1
            continue
        size = length + 8 if first == V1 else length + 12 + (SIGNED if flags & 1 else 0)
        yield TIME.unpack_from(data, at)[0], data[start : start + size]
        at = start + size


class _Kept:
    """Rows of messages, by kind."""

    def __init__(self, path: Path, kinds: dict[str, tuple[int, Callable[[Any], Row | None]]]) -> None:
        self.path, self.kinds = path, kinds
        self.stamps: dict[str, list[int]] = defaultdict(list)
        self.rows: dict[str, list[Row]] = defaultdict(list)

    def take(self, kind: str, micros: int, message: Any) -> None:
        row = self.kinds[kind][1](message)
        if row is not None:
            fields = message.to_dict().items()
            numbers = {name: float(value) for name, value in fields if isinstance(value, int | float)}
            self.stamps[kind].append(1000 * micros)
            self.rows[kind].append(numbers | row)

    def tables(self) -> list[Table]:
        if not self.rows:
            raise NoSource(f"{self.path}: none of {', '.join(self.kinds)} is in it")
        since = min(min(stamps) for stamps in self.stamps.values())
        return [table_of(k, self.stamps[k], rows, since, self.kinds[k][0]) for k, rows in self.rows.items()]

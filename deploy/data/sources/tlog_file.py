"""Read a ground station's recording of a MAVLink link (.tlog), with quantities in ENU and rad added.

Inputs are the setpoints that were sent, with the recorder's time. Telemetry has the vehicle's time, because links are
too late and irregular. The messages with the smallest delay map it to the recorder's clock.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from brakeline.actors.mavlink.ardupilot_dialect import mavlink as dialect
from brakeline.deploy.data.sources.acceleration import GRAVITY, add_accelerations
from brakeline.deploy.data.sources.angles import yaw_from_ned
from brakeline.deploy.data.sources.message_rows import Kinds, MessageRows, Row, vector
from brakeline.deploy.data.sources.source_table import Table
from brakeline.errors import NoSource

TIME = struct.Struct(">Q")  # µs, before each frame
V1, V2, SIGNED = 0xFE, 0xFD, 13  # first bytes of frames; bytes of a signature
VELOCITY_IGNORED, YAW_RATE_IGNORED = 0b111000, 0x800  # in a setpoint's type mask
MAX_DRIFT_RATE = 0.05  # s per s between the two clocks: a simulator on a busy machine needs it


def _local(m: Any) -> Row:
    return vector("position", (m.x, m.y, m.z)) | vector("velocity", (m.vx, m.vy, m.vz))


def _attitude(m: Any) -> Row:
    attitude = {"attitude.yaw": m.yaw, "attitude.pitch": m.pitch, "attitude.roll": m.roll}
    return {"yaw": yaw_from_ned(m.yaw), "yaw rate": -m.yawspeed} | attitude


def _force(m: Any, unit: float = 1.0) -> Row:
    return {"force.x": unit * m.xacc, "force.y": unit * m.yacc, "force.z": unit * m.zacc}


def _milligravities(m: Any) -> Row:
    return _force(m, 1e-3 * GRAVITY)


def _setpoint(m: Any) -> Row | None:
    row: Row = {}
    if m.coordinate_frame == dialect.MAV_FRAME_LOCAL_NED and not m.type_mask & VELOCITY_IGNORED:
        row |= vector("command.velocity", (m.vx, m.vy, m.vz))
    elif not m.type_mask & VELOCITY_IGNORED:
        row |= {"command.body.x": m.vx, "command.body.y": -m.vy, "command.body.z": -m.vz}
    return row | ({} if m.type_mask & YAW_RATE_IGNORED else {"command.yaw rate": -m.yaw_rate})


KINDS: Kinds = {
    "LOCAL_POSITION_NED": (0, _local),
    "ATTITUDE": (0, _attitude),
    "HIGHRES_IMU": (0, _force),
    "SCALED_IMU": (1, _milligravities),
    "SCALED_IMU2": (2, _milligravities),
    "SET_POSITION_TARGET_LOCAL_NED": (0, _setpoint),
}
VEHICLE_STAMPS = {"time_boot_ms": 1e-3, "time_usec": 1e-6}  # field -> unit in s
SENT = "SET_POSITION_TARGET_LOCAL_NED"


def read(path: Path) -> list[Table]:
    """Read a recording, and skip damaged bytes.

    Raises:
        NoSource: the recording has none of the messages, or it has those of several vehicles.
    """
    rows, vehicles = MessageRows(path, KINDS), set[int]()
    parser = dialect.MAVLink(None)
    parser.robust_parsing = True
    for micros, frame in _frames(path.read_bytes()):
        for message in parser.parse_buffer(frame) or ():
            if message.get_type() in KINDS:
                rows.add(message.get_type(), micros, message)
                vehicles |= set() if message.get_type() == SENT else {message.get_srcSystem()}
    if len(vehicles) > 1:
        raise NoSource(f"{path} contains several vehicles: systems {', '.join(map(str, sorted(vehicles)))}")
    tables = rows.tables()
    return add_accelerations([t if t.name == SENT else _on_recorder_clock(t) for t in tables])


def _on_recorder_clock(table: Table) -> Table:
    """Shift the vehicle's stamps by the smallest offset in s of all messages k: `late_k + MAX_DRIFT_RATE |t - t_k|`."""
    stamps = next((unit * table.columns[name] for name, unit in VEHICLE_STAMPS.items() if name in table.columns), None)
    if stamps is None or len(table.time) < 2:
        return table
    late, drift = table.time - stamps, MAX_DRIFT_RATE * stamps
    since = np.minimum.accumulate(late - drift) + drift
    until = np.minimum.accumulate((late + drift)[::-1])[::-1] - drift
    return replace(table, time=stamps + np.minimum(since, until))


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

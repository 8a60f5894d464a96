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
from brakeline.deploy.data.sources.message_tables import Columns, MessageKind, MessageTables
from brakeline.deploy.data.sources.north_east_down import GRAVITY, add_accelerations, enu, force
from brakeline.deploy.data.sources.source_table import Array, Table
from brakeline.errors import NoSource

TIME = struct.Struct(">Q")  # µs, before each frame
V1, V2, SIGNED = 0xFE, 0xFD, 13  # first bytes of frames; bytes of a signature
VELOCITY_IGNORED, YAW_RATE_IGNORED = 0b111000, 0x800  # in a setpoint's type mask
RESTART = 0.5  # s: if the vehicle's stamps step back further, its clock was set anew
MAX_DRIFT_RATE = 0.05  # s per s between the two clocks: a simulator on a busy machine needs it


def _attitude(c: Columns) -> Columns:
    attitude = {"attitude.yaw": c["yaw"], "attitude.pitch": c["pitch"], "attitude.roll": c["roll"]}
    return {"yaw": np.pi / 2.0 - c["yaw"], "yaw rate": -c["yawspeed"]} | attitude


def _setpoint(c: Columns) -> Columns:
    mask, in_world, in_body = c["type_mask"].astype(int), *(np.isin(c["coordinate_frame"], f) for f in (WORLD, OF_BODY))
    moves, turns = (mask & VELOCITY_IGNORED) == 0, (mask & YAW_RATE_IGNORED) == 0
    world, body = enu("command.velocity", c, VELOCITY), dict(zip(BODY, (c["vx"], -c["vy"], -c["vz"]), strict=True))
    return {
        **{name: np.where(moves & in_world, values, np.nan) for name, values in world.items()},
        **{name: np.where(moves & in_body, values, np.nan) for name, values in body.items()},
        "command.yaw rate": np.where(turns, -c["yaw_rate"], np.nan),
    }


# Frames whose velocities are north, east, down, and those whose velocities are forward, right, down.
WORLD = (dialect.MAV_FRAME_LOCAL_NED, dialect.MAV_FRAME_LOCAL_OFFSET_NED)
OF_BODY = (dialect.MAV_FRAME_BODY_NED, dialect.MAV_FRAME_BODY_OFFSET_NED, dialect.MAV_FRAME_BODY_FRD)
VELOCITY, FORCES = ("vx", "vy", "vz"), ("xacc", "yacc", "zacc")
BODY = ("command.body.x", "command.body.y", "command.body.z")
SENT = "SET_POSITION_TARGET_LOCAL_NED"
KINDS = {
    "LOCAL_POSITION_NED": MessageKind(0, lambda c: enu("position", c, "xyz") | enu("velocity", c, VELOCITY)),
    "ATTITUDE": MessageKind(0, _attitude),
    "HIGHRES_IMU": MessageKind(0, lambda c: force(c, FORCES)),
    "SCALED_IMU": MessageKind(1, lambda c: force(c, FORCES, 1e-3 * GRAVITY)),
    "SCALED_IMU2": MessageKind(2, lambda c: force(c, FORCES, 1e-3 * GRAVITY)),
    SENT: MessageKind(0, _setpoint),
}
VEHICLE_STAMPS = {"time_boot_ms": 1e-3, "time_usec": 1e-6}  # field -> unit in s


def read(path: Path) -> list[Table]:
    """Read a recording, and skip damaged bytes.

    Raises:
        NoSource: the recording has none of the messages, or it has those of several vehicles.
    """
    messages, vehicles, data = MessageTables(path), set[int](), path.read_bytes()
    parser, used, damaged = _parser(), 0, 0
    for micros, frame in _frames(data):
        used += TIME.size + len(frame)
        try:
            decoded = parser.parse_buffer(frame) or ()
        except Exception:  # pymavlink raises many types on damaged frames, and keeps their bytes
            parser, damaged = _parser(), damaged + 1
            continue
        for message in decoded:
            name = message.get_type()
            if name in KINDS:
                messages.add(name, KINDS[name], message.to_dict().items(), 1000 * micros)
                vehicles |= set() if name == SENT else {message.get_srcSystem()}
    if damaged or used < len(data):
        messages.damage.append(f"{damaged} damaged frames and {len(data) - used} bytes between frames are left out")
    if len(vehicles) > 1:
        raise NoSource(f"{path} contains several vehicles: systems {', '.join(map(str, sorted(vehicles)))}")
    tables = messages.tables(f"the log contains none of the messages {', '.join(KINDS)}")
    return add_accelerations([t if t.name == SENT else _on_recorder_clock(t, path) for t in tables])


def _parser() -> Any:
    parser = dialect.MAVLink(None)
    parser.robust_parsing = True
    return parser


def _on_recorder_clock(table: Table, path: Path) -> Table:
    """Date a table by the vehicle's stamps, on the recorder's clock. Each part between two restarts is on its own."""
    stamps = next((unit * table.columns[name] for name, unit in VEHICLE_STAMPS.items() if name in table.columns), None)
    if stamps is None or len(table.time) < 2:
        return table
    restarts = np.flatnonzero((np.diff(stamps) < -RESTART) | (np.diff(table.run) != 0)) + 1
    parts = zip(np.split(table.time, restarts), np.split(stamps, restarts), strict=True)
    time = np.concatenate([_dated(received, stamps) for received, stamps in parts])
    order = np.argsort(time, kind="stable")
    columns = {name: values[order] for name, values in table.columns.items()}
    note = f"{path}: the stamps of {table.name} step back {len(restarts)} times: the parts are dated one by one"
    run = table.run[order]
    return replace(
        table, time=time[order], columns=columns, run=run, notes=(*table.notes, *[note] * bool(len(restarts)))
    )


def _dated(received: Array, stamps: Array) -> Array:
    """Shift stamps by the smallest offset in s of all messages k: `late_k + MAX_DRIFT_RATE |t - t_k|`."""
    late, drift = received - stamps, MAX_DRIFT_RATE * stamps
    since = np.minimum.accumulate(late - drift) + drift
    until = np.minimum.accumulate((late + drift)[::-1])[::-1] - drift
    return np.asarray(stamps + np.minimum(since, until))


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

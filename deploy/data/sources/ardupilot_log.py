"""Read ArduPilot's logs (.bin, .log): one table per message type, with quantities in ENU and rad added.

Inputs are the setpoints: desired speed and turn rate of a rover; the velocities that a copter received in guided mode
or, if there are none, the targets of its own position control.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any

os.environ.setdefault("MAVLINK20", "1")

import numpy as np
from pymavlink import DFReader

from brakeline.deploy.data.sources.message_tables import Columns, MessageKind, MessageTables
from brakeline.deploy.data.sources.north_east_down import add_accelerations, along_body, enu, force
from brakeline.deploy.data.sources.source_table import Table

BINARY = b"\xa3\x95"  # the first bytes of each binary message
LABELS = 4  # place of the first field's name in a line FMT: type, length, name, format, fields
CENTI = 0.01
TARGET = 1  # rank of controller targets, behind received setpoints
# Messages of the first core, the first unit, and of guided velocities: field -> value.
ONLY = {"XKF1": ("C", 0), "NKF1": ("C", 0), "IMU": ("I", 0), "GUID": ("Type", 2)}


def _filter(c: Columns) -> Columns:
    """Return state quantities of the estimator."""
    yaw, pitch, roll = (np.radians(c[name]) for name in ("Yaw", "Pitch", "Roll"))
    velocity = enu("velocity", c, ("VN", "VE", "VD"))
    attitude = {"attitude.yaw": yaw, "attitude.pitch": pitch, "attitude.roll": roll}
    return enu("position", c, ("PN", "PE", "PD")) | velocity | along_body(velocity, yaw) | attitude


KINDS = {
    "XKF1": MessageKind(0, _filter),
    "NKF1": MessageKind(1, _filter),
    "IMU": MessageKind(0, lambda c: {"yaw rate": -c["GyrZ"]} | force(c, ("AccX", "AccY", "AccZ"))),
    "THR": MessageKind(0, lambda c: {"command.body.x": c["DesSpeed"]}),
    "STER": MessageKind(0, lambda c: {"command.yaw rate": -np.radians(c["DesTurnRate"])}),
    # Guided velocities are in cm/s (north, east, up), whatever unit the log declares.
    "GUID": MessageKind(0, lambda c: enu("command.velocity", c | {"down": -c["vZ"]}, ("vX", "vY", "down"), CENTI)),
    "PSCN": MessageKind(TARGET, lambda c: {"command.velocity.y": c["DVN"]}),
    "PSCE": MessageKind(TARGET, lambda c: {"command.velocity.x": c["DVE"]}),
    "PSCD": MessageKind(TARGET, lambda c: {"command.velocity.z": -c["DVD"]}),
    "PSC": MessageKind(TARGET, lambda c: {"command.velocity.x": c["TVY"], "command.velocity.y": c["TVX"]}),
    "CTUN": MessageKind(TARGET, lambda c: {"command.velocity.z": CENTI * c["DCRt"]} if "DCRt" in c else {}),
}


def read(path: Path) -> list[Table]:
    """Read a log, binary (.bin) or text (.log). A damaged log is read as far as it goes.

    Raises:
        NoSource: the file is not an ArduPilot log, or has none of the messages.
    """
    messages = MessageTables(path)
    with path.open("rb") as file:
        binary = file.read(2) == BINARY
    with messages.until_damaged():
        for name, fields in _binary_messages(path) if binary else _text_messages(path, messages):
            field, value = ONLY.get(name, ("", None))
            if fields.get(field, value) == value and isinstance(micros := fields.get("TimeUS"), int):
                messages.add(name, KINDS[name], fields.items(), 1000 * micros)
    tables = messages.tables(f"the file contains none of ArduPilot's messages {', '.join(KINDS)}")
    return add_accelerations(tables)


def _binary_messages(path: Path) -> Iterator[tuple[str, dict[str, Any]]]:
    with DFReader.DFReader_binary(str(path)) as log:
        while (message := log.recv_match(type=list(KINDS))) is not None:
            yield message.get_type(), message.to_dict()


def _text_messages(path: Path, messages: MessageTables) -> Iterator[tuple[str, dict[str, Any]]]:
    """Yield the messages of a text log: each line is a name and values; lines FMT name the fields.

    `pymavlink` reads such logs too, but not beyond the first damaged byte.
    """
    fields: dict[str, list[str]] = {}
    damaged = 0
    with path.open(encoding="utf-8", errors="replace") as lines:
        for line in lines:
            name, *values = (cell.strip() for cell in line.split(","))
            if name == "FMT" and len(values) > LABELS:
                fields[values[LABELS - 2]] = values[LABELS:]
            elif name in KINDS:
                numbers = [_number(value) for value in values]
                if None in numbers or len(numbers) != len(fields.get(name, ())):
                    damaged += 1
                else:
                    yield name, dict(zip(fields[name], numbers, strict=True))
    if damaged:
        messages.damage.append(f"{damaged} damaged lines are left out")


def _number(text: str) -> int | float | None:
    """Return a number, or None if the text is none. Integers stay exact: a time stamp may have 16 digits."""
    try:
        return int(text) if text.isdecimal() and len(text) < 20 else float(text)
    except ValueError:
        return None

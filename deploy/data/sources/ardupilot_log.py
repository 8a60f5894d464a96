"""Read ArduPilot's logs (.bin): one table per message type, with quantities in ENU and rad added.

Inputs are the setpoints: desired speed and turn rate of a rover; the velocities that a copter received in guided mode
or, if there are none, the targets of its own position control.
"""

from __future__ import annotations

import os
from pathlib import Path

os.environ.setdefault("MAVLINK20", "1")

import numpy as np
from pymavlink import DFReader

from brakeline.deploy.data.sources.message_tables import Columns, MessageKind, MessageTables
from brakeline.deploy.data.sources.north_east_down import add_accelerations, along_body, enu, force
from brakeline.deploy.data.sources.source_table import Table
from brakeline.errors import NoSource

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


def _guided(c: Columns) -> Columns:
    """Return guided velocities. The log holds cm/s (north, east, up), whatever unit it declares."""
    return enu("command.velocity", c | {"down": -c["vZ"]}, ("vX", "vY", "down"), CENTI)


KINDS = {
    "XKF1": MessageKind(0, _filter),
    "NKF1": MessageKind(1, _filter),
    "IMU": MessageKind(0, lambda c: {"yaw rate": -c["GyrZ"]} | force(c, ("AccX", "AccY", "AccZ"))),
    "THR": MessageKind(0, lambda c: {"command.body.x": c["DesSpeed"]}),
    "STER": MessageKind(0, lambda c: {"command.yaw rate": -np.radians(c["DesTurnRate"])}),
    "GUID": MessageKind(0, _guided),
    "PSCN": MessageKind(TARGET, lambda c: {"command.velocity.y": c["DVN"]}),
    "PSCE": MessageKind(TARGET, lambda c: {"command.velocity.x": c["DVE"]}),
    "PSCD": MessageKind(TARGET, lambda c: {"command.velocity.z": -c["DVD"]}),
    "PSC": MessageKind(TARGET, lambda c: {"command.velocity.x": c["TVY"], "command.velocity.y": c["TVX"]}),
    "CTUN": MessageKind(TARGET, lambda c: {"command.velocity.z": CENTI * c["DCRt"]} if "DCRt" in c else {}),
}


def read(path: Path) -> list[Table]:
    """Read a log. Raises NoSource if the file is not an ArduPilot log, or has none of the messages."""
    try:
        log = DFReader.DFReader_binary(str(path))
    except Exception as error:  # pymavlink raises many types on damaged files
        raise NoSource(f"{path} is not an ArduPilot log: {error}") from error
    messages = MessageTables()
    while (message := log.recv_match(type=list(KINDS))) is not None:
        name, fields = message.get_type(), message.to_dict()
        field, value = ONLY.get(name, ("", None))
        if fields.get(field, value) == value:
            messages.add(name, KINDS[name], fields.items(), 1000 * int(message.TimeUS))
    log.close()
    return add_accelerations(messages.tables(f"{path}: the log contains none of the messages {', '.join(KINDS)}"))

"""Read ArduPilot's logs (.bin): one table per message type, with quantities in ENU and rad added.

Inputs are the setpoints: desired speed and turn rate of a rover; the velocities that a copter received in guided mode
or, if there are none, the targets of its own position control.
"""

from __future__ import annotations

import math
import os
from pathlib import Path
from typing import Any

os.environ.setdefault("MAVLINK20", "1")

from pymavlink import DFReader

from brakeline.deploy.data.sources.acceleration import add_accelerations
from brakeline.deploy.data.sources.angles import yaw_from_ned
from brakeline.deploy.data.sources.message_rows import Kinds, MessageRows, Row, along_body, vector
from brakeline.deploy.data.sources.source_table import Table
from brakeline.errors import NoSource

CENTI = 0.01
GUIDED_VELOCITY = 2  # type of a GUID message
TARGET = 1  # rank of controller targets, behind received setpoints


def _filter(m: Any) -> Row | None:
    """Return state quantities from the first core of the estimator."""
    if getattr(m, "C", 0) != 0:
        return None
    roll, pitch, down_turned = (math.radians(angle) for angle in (m.Roll, m.Pitch, m.Yaw))
    velocity, yaw = vector("velocity", (m.VN, m.VE, m.VD)), yaw_from_ned(down_turned)
    attitude = {"attitude.yaw": down_turned, "attitude.pitch": pitch, "attitude.roll": roll}
    return vector("position", (m.PN, m.PE, m.PD)) | velocity | along_body(velocity, yaw) | {"yaw": yaw} | attitude


def _inertial(m: Any) -> Row | None:
    """Return yaw rate and specific force from the first unit."""
    if getattr(m, "I", 0) != 0:
        return None
    return {"yaw rate": -m.GyrZ, "force.x": m.AccX, "force.y": m.AccY, "force.z": m.AccZ}


def _guided(m: Any) -> Row | None:
    """Return a guided velocity. The log holds cm/s (north, east, up), whatever unit it declares."""
    return (
        vector("command.velocity", (CENTI * m.vX, CENTI * m.vY, -CENTI * m.vZ)) if m.Type == GUIDED_VELOCITY else None
    )


KINDS: Kinds = {
    "XKF1": (0, _filter),
    "NKF1": (1, _filter),
    "IMU": (0, _inertial),
    "THR": (0, lambda m: {"command.body.x": m.DesSpeed}),
    "STER": (0, lambda m: {"command.yaw rate": -math.radians(m.DesTurnRate)}),
    "GUID": (0, _guided),
    "PSCN": (TARGET, lambda m: {"command.velocity.y": m.DVN}),
    "PSCE": (TARGET, lambda m: {"command.velocity.x": m.DVE}),
    "PSCD": (TARGET, lambda m: {"command.velocity.z": -m.DVD}),
    "PSC": (TARGET, lambda m: {"command.velocity.x": m.TVY, "command.velocity.y": m.TVX}),
    "CTUN": (TARGET, lambda m: {"command.velocity.z": CENTI * m.DCRt} if hasattr(m, "DCRt") else None),
}


def read(path: Path) -> list[Table]:
    """Read a log. Raises NoSource if the file is not an ArduPilot log, or has none of the messages."""
    try:
        log = DFReader.DFReader_binary(str(path))
    except Exception as error:  # pymavlink raises many types on damaged files
        raise NoSource(f"{path} is not an ArduPilot log: {error}") from error
    rows = MessageRows(path, KINDS)
    while (message := log.recv_match(type=list(KINDS))) is not None:
        rows.add(message.get_type(), int(message.TimeUS), message)
    log.close()
    return add_accelerations(rows.tables())

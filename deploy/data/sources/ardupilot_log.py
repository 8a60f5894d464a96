"""ArduPilot's own logs (.bin): a table a kind of message, in ENU and rad beside what the message has.

Inputs are what the autopilot was told: a rover's desired speed and turn rate; the velocities that a copter was sent in
guided mode, or, where nobody sent any, those that its own position control aimed at.
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
from brakeline.deploy.data.sources.message_rows import Kept, Kinds, Row, along_body, vector
from brakeline.deploy.data.sources.source_table import NoSource, Table

CENTI = 0.01
GUIDED_VELOCITY = 2  # of GUID's types
AIMED = 1  # rank of what a controller aims at, behind what it was told


def _filter(m: Any) -> Row | None:
    """The first core of the state estimator."""
    if getattr(m, "C", 0) != 0:
        return None
    roll, pitch, down_turned = (math.radians(angle) for angle in (m.Roll, m.Pitch, m.Yaw))
    velocity, yaw = vector("velocity", (m.VN, m.VE, m.VD)), yaw_from_ned(down_turned)
    attitude = {"attitude.yaw": down_turned, "attitude.pitch": pitch, "attitude.roll": roll}
    return vector("position", (m.PN, m.PE, m.PD)) | velocity | along_body(velocity, yaw) | {"yaw": yaw} | attitude


def _inertial(m: Any) -> Row | None:
    """The first unit's."""
    if getattr(m, "I", 0) != 0:
        return None
    return {"yaw rate": -m.GyrZ, "force.x": m.AccX, "force.y": m.AccY, "force.z": m.AccZ}


def _guided(m: Any) -> Row | None:
    """North, east, up, in cm/s whatever the log says its unit is."""
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
    "PSCN": (AIMED, lambda m: {"command.velocity.y": m.DVN}),
    "PSCE": (AIMED, lambda m: {"command.velocity.x": m.DVE}),
    "PSCD": (AIMED, lambda m: {"command.velocity.z": -m.DVD}),
    "PSC": (AIMED, lambda m: {"command.velocity.x": m.TVY, "command.velocity.y": m.TVX}),
    "CTUN": (AIMED, lambda m: {"command.velocity.z": CENTI * m.DCRt} if hasattr(m, "DCRt") else None),
}


def read(path: Path) -> list[Table]:
    """Raises NoSource: it is no such log, or has none of the messages."""
    try:
        log = DFReader.DFReader_binary(str(path))
    except Exception as error:  # whatever pymavlink stumbles over
        raise NoSource(f"{path} is no log of ArduPilot: {error}") from error
    kept = Kept(path, KINDS)
    while (message := log.recv_match(type=list(KINDS))) is not None:
        kept.take(message.get_type(), int(message.TimeUS), message)
    log.close()
    return add_accelerations(kept.tables())

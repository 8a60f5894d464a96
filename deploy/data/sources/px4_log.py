"""Read PX4's logs (.ulg): one table per message, with quantities in ENU added. Setpoints are the inputs."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from pyulog import ULog

from brakeline.deploy.data.sources.message_tables import Columns, MessageKind, with_quantities
from brakeline.deploy.data.sources.north_east_down import along_body, enu
from brakeline.deploy.data.sources.source_table import Table
from brakeline.errors import NoSource

VELOCITY = ("vx", "vy", "vz")


def _local_position(c: Columns) -> Columns:
    velocity = enu("velocity", c, VELOCITY)
    body = along_body(velocity, c["heading"]) if "heading" in c else {}
    return enu("position", c, "xyz") | velocity | enu("acceleration", c, ("ax", "ay", "az")) | body


def _setpoint(c: Columns) -> Columns:
    velocity = enu("command.velocity", c, ("velocity[0]", "velocity[1]", "velocity[2]"))
    turn = {"command.yaw rate": -c["yawspeed"]} if "yawspeed" in c else {}
    return (velocity or enu("command.velocity", c, VELOCITY)) | turn


KINDS = {
    "vehicle_local_position": MessageKind(0, _local_position),
    "vehicle_angular_velocity": MessageKind(0, lambda c: {"yaw rate": -c["xyz[2]"]}),
    "trajectory_setpoint": MessageKind(0, _setpoint),
}


def read(path: Path) -> list[Table]:
    """Read a log. Raises NoSource if the file is not a ULog, or has none of the messages."""
    try:
        log = ULog(str(path), list(KINDS))
    except Exception as error:  # pyulog raises many types on damaged files
        raise NoSource(f"{path} is not a ULog file: {error}") from error
    messages = [one for one in log.data_list if one.multi_id == 0 and len(one.data["timestamp"])]
    if not messages:
        raise NoSource(f"{path}: the log contains none of the messages {', '.join(KINDS)}")
    since = min(int(one.data["timestamp"][0]) for one in messages)
    return [_table(path, one.name, one.data, since) for one in messages]


def _table(path: Path, name: str, data: dict[str, np.ndarray], since: int) -> Table:
    stamp = data["timestamp_sample"] if data.get("timestamp_sample", np.zeros(1)).all() else data["timestamp"]
    columns = {key: np.asarray(values, float) for key, values in data.items() if not key.startswith("timestamp")}
    return with_quantities(Table(name, (stamp.astype(np.int64) - since) / 1e6, columns), KINDS[name], path)

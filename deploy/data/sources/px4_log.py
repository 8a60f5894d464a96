"""Read PX4's logs (.ulg): one table per message, with quantities in ENU added. Setpoints are the inputs."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from pyulog import ULog

from brakeline.deploy.data.sources.source_table import Array, Table
from brakeline.errors import NoSource

VELOCITY = ("vx", "vy", "vz")
SET = ("velocity[0]", "velocity[1]", "velocity[2]")
MESSAGES = ("vehicle_local_position", "vehicle_angular_velocity", "trajectory_setpoint")


def read(path: Path) -> list[Table]:
    """Read a log. Raises NoSource if the file is not a ULog, or has none of the messages."""
    try:
        log = ULog(str(path), list(MESSAGES))
    except Exception as error:  # pyulog raises many types on damaged files
        raise NoSource(f"{path} is not a ULog file: {error}") from error
    messages = [one for one in log.data_list if one.multi_id == 0 and len(one.data["timestamp"])]
    if not messages:
        raise NoSource(f"{path}: the log contains none of the messages {', '.join(MESSAGES)}")
    since = min(int(one.data["timestamp"][0]) for one in messages)
    return [_table(one.name, one.data, since) for one in messages]


def _table(name: str, data: dict[str, Any], since: int) -> Table:
    stamp = data["timestamp_sample"] if data.get("timestamp_sample", np.zeros(1)).all() else data["timestamp"]
    time = (stamp.astype(np.int64) - since) / 1e6
    columns = {key: np.asarray(values, float) for key, values in data.items() if not key.startswith("timestamp")}
    more: dict[str, Array] = {}
    if name == "vehicle_local_position":
        more |= _enu("position", columns, ("x", "y", "z"))
        more |= _enu("velocity", columns, VELOCITY)
        more |= _enu("acceleration", columns, ("ax", "ay", "az"))
        if "heading" in columns:
            more["yaw"] = np.pi / 2.0 - columns["heading"]
            forward, left = np.cos(more["yaw"]), np.sin(more["yaw"])
            more["body.x"] = forward * more["velocity.x"] + left * more["velocity.y"]
            more["body.y"] = forward * more["velocity.y"] - left * more["velocity.x"]
            more["body.z"] = more["velocity.z"]
    elif name == "vehicle_angular_velocity":
        more["yaw rate"] = -columns["xyz[2]"]
    elif name == "trajectory_setpoint":
        more |= _enu("command.velocity", columns, SET if SET[0] in columns else VELOCITY)
        if "yawspeed" in columns:
            more["command.yaw rate"] = -columns["yawspeed"]
    return Table(name, time, columns | more)


def _enu(kind: str, columns: dict[str, Array], names: tuple[str, str, str]) -> dict[str, Array]:
    if any(name not in columns for name in names):
        return {}
    north, east, down = (columns[name] for name in names)
    return {f"{kind}.x": east, f"{kind}.y": north, f"{kind}.z": -down}

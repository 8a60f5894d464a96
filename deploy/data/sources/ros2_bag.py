"""Read ROS 2 bags (sqlite3 or MCAP) without ROS: one table per topic, and for TF one per frame.

Fields have their names in the message (`twist.twist.linear.x`, `velocity.wheel_left` of a JointState); the quantities
of `quantity_names` are added. Times come from the headers, unless the headers use another clock than the bag.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from rosbags.highlevel import AnyReader, AnyReaderError
from rosbags.typesys import Stores, get_typestore
from scipy.spatial.transform import Rotation

from brakeline.deploy.data.sources.message_tables import Columns, MessageKind, MessageTables
from brakeline.deploy.data.sources.quantity_names import AXES
from brakeline.deploy.data.sources.source_table import Table
from brakeline.errors import NoSource

FIRST = ("/odom", "/cmd_vel")  # topics that are preferred over others of the same type


def _vector(kind: str, columns: Columns, field: str) -> Columns:
    return {f"{kind}.{axis}": columns[f"{field}.{axis}"] for axis in AXES}


def _attitude(columns: Columns, field: str) -> np.ndarray:
    """Return the quaternions (T, 4), x, y, z, w."""
    return np.column_stack([columns[f"{field}.{part}"] for part in "xyzw"])


def _pose(columns: Columns, position: str, orientation: str) -> Columns:
    x, y, z, w = _attitude(columns, orientation).T
    yaw = np.arctan2(2.0 * (w * z + x * y), w * w + x * x - y * y - z * z)  # for quaternions of any length
    return _vector("position", columns, position) | {"yaw": yaw}


def _odometry(columns: Columns) -> Columns:
    """Return pose and velocity; by definition, the twist is in the child frame."""
    body = _vector("body", columns, "twist.twist.linear")
    world = Rotation.from_quat(_attitude(columns, "pose.pose.orientation")).apply(np.column_stack(list(body.values())))
    pose = _pose(columns, "pose.pose.position", "pose.pose.orientation")
    velocity = {f"velocity.{axis}": values for axis, values in zip(AXES, world.T, strict=True)}
    return pose | body | velocity | {"yaw rate": columns["twist.twist.angular.z"]}


def _twist(columns: Columns, field: str = "") -> Columns:
    linear = f"{field}linear"
    return {
        **_vector("command.body", columns, linear),
        **_vector("command.velocity", columns, linear),
        "command.yaw rate": columns[f"{field}angular.z"],
    }


def _ackermann(columns: Columns) -> Columns:
    fields = {"body.x": "speed", "steering": "steering_angle", "acceleration": "acceleration"}
    return {f"command.{name}": columns[f"drive.{field}"] for name, field in fields.items()}


# The rank of `/odom` is below that of other odometry, and so on: the lowest rank is preferred.
KINDS = {
    "nav_msgs/msg/Odometry": MessageKind(1, _odometry),
    "geometry_msgs/msg/PoseStamped": MessageKind(3, lambda c: _pose(c, "pose.position", "pose.orientation")),
    "tf2_msgs/msg/TFMessage": MessageKind(5, lambda c: _pose(c, "translation", "rotation")),
    "ackermann_msgs/msg/AckermannDriveStamped": MessageKind(1, _ackermann),
    "geometry_msgs/msg/TwistStamped": MessageKind(3, lambda c: _twist(c, "twist.")),
    "geometry_msgs/msg/Twist": MessageKind(3, _twist),
    "sensor_msgs/msg/JointState": MessageKind(7),
    "std_msgs/msg/Float64": MessageKind(9),
    "std_msgs/msg/Float32": MessageKind(9),
}


def read(path: Path) -> list[Table]:
    """Read a bag. Raises NoSource if it is not a bag, or no topic has a supported type."""
    messages, available = MessageTables(), list[str]()
    try:
        with AnyReader([path], default_typestore=get_typestore(Stores.LATEST)) as bag:
            available = sorted({f"{c.topic} ({c.msgtype})" for c in bag.connections})
            known = [c for c in bag.connections if c.msgtype in KINDS]
            for connection, received, raw in bag.messages(connections=known) if known else ():
                message = bag.deserialize(raw, connection.msgtype)
                kind = KINDS[connection.msgtype]
                kind = kind._replace(rank=kind.rank - (connection.topic in FIRST))
                parts: Sequence[Any] = getattr(message, "transforms", (message,))  # TF: a table for each frame
                for part in parts:
                    frames = f":{part.header.frame_id}:{part.child_frame_id}" if part is not message else ""
                    fields = _numbers(part if part is message else part.transform)
                    messages.add(connection.topic + frames, kind, fields, _stamp(part) or received, received)
    except (AnyReaderError, OSError) as error:
        raise NoSource(f"{path}: {error}") from error
    missing = f"{path}: no topic has a supported type ({', '.join(KINDS)}). The bag contains: {available}"
    return messages.tables(missing)


def _stamp(message: Any) -> int:
    """Return the time of the header in ns; 0 without a header."""
    header = getattr(message, "header", None)
    return 0 if header is None else int(header.stamp.sec * 1_000_000_000 + header.stamp.nanosec)


def _numbers(message: Any) -> Iterator[tuple[str, float]]:
    """Yield the numbers of a message with their field names, without arrays, and the values of named joints."""
    joints: Sequence[str] = getattr(message, "name", ())
    for name in message.__dataclass_fields__:
        value = getattr(message, name)
        if isinstance(value, bool | int | float):
            yield name, float(value)
        elif isinstance(value, np.ndarray) and not isinstance(joints, str) and len(value) == len(joints):
            yield from ((f"{name}.{joint}", float(number)) for joint, number in zip(joints, value, strict=True))
        elif name != "header" and hasattr(value, "__dataclass_fields__"):
            yield from ((f"{name}.{inner}", number) for inner, number in _numbers(value))

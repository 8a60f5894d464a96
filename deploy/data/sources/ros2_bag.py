"""Read ROS 2 bags (sqlite3 or MCAP) without ROS: one table per topic, and for TF one per frame.

Fields have their names in the message (`twist.twist.linear.x`, `velocity.wheel_left` of a JointState); the quantities
of `quantity_names` are added. Times come from the headers, unless the headers use another clock than the bag.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
from rosbags.highlevel import AnyReader, AnyReaderError
from rosbags.typesys import Stores, get_typestore

from brakeline.deploy.data.sources.angles import turned, yaw_of
from brakeline.deploy.data.sources.quantity_names import AXES
from brakeline.deploy.data.sources.source_table import Table, table_of
from brakeline.errors import NoSource

Row = dict[str, float]
OTHER_CLOCK = 1_000_000_000  # ns: a larger median difference of header and bag means two clocks
FIRST = ("/odom", "/cmd_vel")  # topics that are preferred over others of the same type


def read(path: Path) -> list[Table]:
    """Read a bag. Raises NoSource if it is not a bag, or no topic has a supported type."""
    stamps: dict[str, list[tuple[int, int]]] = defaultdict(list)
    rows: dict[str, list[Row]] = defaultdict(list)
    ranks: dict[str, int] = {}
    try:
        with AnyReader([path], default_typestore=get_typestore(Stores.LATEST)) as bag:
            available = sorted({f"{c.topic} ({c.msgtype})" for c in bag.connections})
            known = [c for c in bag.connections if c.msgtype in TYPES]
            for connection, received, raw in bag.messages(connections=known) if known else ():
                rank, rows_of = TYPES[connection.msgtype]
                message = bag.deserialize(raw, connection.msgtype)
                for suffix, header, row in rows_of(message):
                    name = connection.topic + suffix
                    stamps[name].append((_nanoseconds(header, received), received))
                    rows[name].append(row)
                    ranks[name] = rank - (name in FIRST)
    except (AnyReaderError, OSError) as error:
        raise NoSource(f"{path}: {error}") from error
    if not rows:
        raise NoSource(f"{path}: no topic has a supported type ({', '.join(TYPES)}). The bag contains: {available}")
    times = {name: _times(np.array(both, np.int64)) for name, both in stamps.items()}
    since = min(int(time.min()) for time in times.values())
    return [table_of(name, list(map(int, times[name])), rows[name], since, ranks[name]) for name in rows]


def _nanoseconds(header: Any, received: int) -> int:
    stamp = 0 if header is None else header.stamp.sec * 1_000_000_000 + header.stamp.nanosec
    return stamp or received


def _times(both: np.ndarray) -> np.ndarray:
    """Return the times (T,) of a topic from (T, 2): header stamps, or receive times if the clocks differ."""
    stamped, received = both.T
    return np.asarray(received if np.median(np.abs(stamped - received)) > OTHER_CLOCK else stamped)


def _plain(message: Any) -> Iterator[tuple[str, float]]:
    """Yield the numbers of a message with their field names, without arrays."""
    for name in message.__dataclass_fields__:
        value = getattr(message, name)
        if name == "header" or isinstance(value, str | bytes | list | np.ndarray):
            continue
        if isinstance(value, bool | int | float):
            yield name, float(value)
        elif hasattr(value, "__dataclass_fields__"):
            yield from ((f"{name}.{inner}", number) for inner, number in _plain(value))


def _pose(position: Any, q: Any) -> Row:
    return {f"position.{axis}": float(getattr(position, axis)) for axis in AXES} | {"yaw": yaw_of(q.x, q.y, q.z, q.w)}


def _odometry(message: Any) -> Iterator[tuple[str, Any, Row]]:
    """Convert Odometry; by definition, its twist is in the child frame."""
    pose, twist = message.pose.pose, message.twist.twist
    q, body = pose.orientation, [float(getattr(twist.linear, axis)) for axis in AXES]
    row = dict(_plain(message)) | _pose(pose.position, q) | {"yaw rate": float(twist.angular.z)}
    row |= {f"body.{axis}": value for axis, value in zip(AXES, body, strict=True)}
    world = turned((q.x, q.y, q.z, q.w), body)
    yield "", message.header, row | {f"velocity.{axis}": value for axis, value in zip(AXES, world, strict=True)}


def _pose_stamped(message: Any) -> Iterator[tuple[str, Any, Row]]:
    pose = message.pose
    yield "", message.header, dict(_plain(message)) | _pose(pose.position, pose.orientation)


def _frames(message: Any) -> Iterator[tuple[str, Any, Row]]:
    for one in message.transforms:
        frames = f":{one.header.frame_id}:{one.child_frame_id}"
        yield frames, one.header, _pose(one.transform.translation, one.transform.rotation)


def _command(twist: Any) -> Row:
    row = {
        f"command.{frame}.{axis}": float(getattr(twist.linear, axis)) for frame in ("body", "velocity") for axis in AXES
    }
    return row | {"command.yaw rate": float(twist.angular.z)}


def _twist(message: Any) -> Iterator[tuple[str, Any, Row]]:
    yield "", None, dict(_plain(message)) | _command(message)


def _twist_stamped(message: Any) -> Iterator[tuple[str, Any, Row]]:
    yield "", message.header, dict(_plain(message)) | _command(message.twist)


def _ackermann(message: Any) -> Iterator[tuple[str, Any, Row]]:
    drive = message.drive
    command = {"body.x": drive.speed, "steering": drive.steering_angle, "acceleration": drive.acceleration}
    yield "", message.header, dict(_plain(message)) | {f"command.{name}": float(v) for name, v in command.items()}


def _joints(message: Any) -> Iterator[tuple[str, Any, Row]]:
    parts = {kind: getattr(message, kind) for kind in ("position", "velocity", "effort")}
    named = {
        f"{kind}.{name}": float(value)
        for kind, values in parts.items()
        if len(values) == len(message.name)
        for name, value in zip(message.name, values, strict=True)
    }
    yield "", message.header, named


def _number(message: Any) -> Iterator[tuple[str, Any, Row]]:
    yield "", None, dict(_plain(message))


# Message type -> (rank: the lowest is preferred, function that returns rows).
TYPES: dict[str, tuple[int, Callable[[Any], Iterator[tuple[str, Any, Row]]]]] = {
    "nav_msgs/msg/Odometry": (1, _odometry),
    "geometry_msgs/msg/PoseStamped": (3, _pose_stamped),
    "tf2_msgs/msg/TFMessage": (5, _frames),
    "ackermann_msgs/msg/AckermannDriveStamped": (1, _ackermann),
    "geometry_msgs/msg/TwistStamped": (3, _twist_stamped),
    "geometry_msgs/msg/Twist": (3, _twist),
    "sensor_msgs/msg/JointState": (7, _joints),
    "std_msgs/msg/Float64": (9, _number),
    "std_msgs/msg/Float32": (9, _number),
}

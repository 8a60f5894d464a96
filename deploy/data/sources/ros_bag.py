"""Read ROS 1 and ROS 2 bags (.bag, sqlite3 or MCAP) without ROS: one table per topic, and for TF one per frame.

Fields have their names in the message (`twist.twist.linear.x`, `velocity.wheel_left` of a JointState); the quantities
of `quantity_names` are added. Times come from the headers, unless the headers use another clock than the bag.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from rosbags.typesys import Stores, get_types_from_idl, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

from brakeline.deploy.data.sources.bag_storage import ROS1, BagContents, BagTopic, stored_messages
from brakeline.deploy.data.sources.message_tables import Columns, MessageKind, MessageTables
from brakeline.deploy.data.sources.quantity_names import AXES
from brakeline.deploy.data.sources.source_table import Table, natural_order
from brakeline.errors import NoSource

ENDINGS = (".bag", ".bag.active", ".db3", ".db3.zstd", ".mcap", ".mcap.zstd")
FIXED = "/tf_static"  # poses of parts on the robot, which do not move
FIRST = ("/odom", "/cmd_vel")  # topics that are preferred over others of the same type


def _vector(kind: str, columns: Columns, field: str) -> Columns:
    return {f"{kind}.{axis}": columns[f"{field}.{axis}"] for axis in AXES}


def _attitude(columns: Columns, field: str) -> np.ndarray:
    """Return the quaternions (T, 4), x, y, z, w."""
    return np.column_stack([columns[f"{field}.{part}"] for part in "xyzw"])


def _rotated(vectors: np.ndarray, attitudes: np.ndarray) -> np.ndarray:
    """Rotate vectors (T, 3) by quaternions (T, 4) of any length; zeros, which are no attitude, give NaN."""
    lengths = np.linalg.norm(attitudes, axis=1, keepdims=True)
    unit = np.divide(attitudes, lengths, out=np.full_like(attitudes, np.nan), where=lengths > 0.0)
    axis, w = unit[:, :3], unit[:, 3:]
    across = np.cross(axis, vectors)
    return np.asarray(vectors + 2.0 * (w * across + np.cross(axis, across)))


def _pose(columns: Columns, position: str, orientation: str) -> Columns:
    x, y, z, w = _attitude(columns, orientation).T
    yaw = np.arctan2(2.0 * (w * z + x * y), w * w + x * x - y * y - z * z)  # for quaternions of any length
    yaw = np.where(x * x + y * y + z * z + w * w > 0.0, yaw, np.nan)  # zeros are no attitude
    return _vector("position", columns, position) | {"yaw": yaw}


def _odometry(columns: Columns) -> Columns:
    """Return pose and velocity; by definition, the twist is in the child frame."""
    body = _vector("body", columns, "twist.twist.linear")
    world = _rotated(np.column_stack(list(body.values())), _attitude(columns, "pose.pose.orientation"))
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


TRANSFORM = MessageKind(5, lambda c: _pose(c, "translation", "rotation"))
# The rank of `/odom` is below that of other odometry, and so on: the lowest rank is preferred.
KINDS = {
    "nav_msgs/msg/Odometry": MessageKind(1, _odometry),
    "geometry_msgs/msg/PoseStamped": MessageKind(3, lambda c: _pose(c, "pose.position", "pose.orientation")),
    "tf2_msgs/msg/TFMessage": TRANSFORM,
    "tf/msg/tfMessage": TRANSFORM,  # of early ROS 1
    "ackermann_msgs/msg/AckermannDriveStamped": MessageKind(1, _ackermann),
    "geometry_msgs/msg/TwistStamped": MessageKind(3, lambda c: _twist(c, "twist.")),
    "geometry_msgs/msg/Twist": MessageKind(3, _twist),
    "sensor_msgs/msg/JointState": MessageKind(7),
    "std_msgs/msg/Float64": MessageKind(9),
    "std_msgs/msg/Float32": MessageKind(9),
}


def read(path: Path) -> list[Table]:
    """Read a bag: a file, or a folder with the files of one recording. A damaged bag is read as far as it goes.

    Raises:
        NoSource: the path is not a bag, or no topic has a supported type.
    """
    messages, contents = MessageTables(path), BagContents()
    for file in files_of(path):
        try:
            with messages.until_damaged():
                _add_messages(file, messages, contents)
        except NoSource as error:
            if path.is_file():
                raise
            contents.damage.append(str(error))
    messages.damage += contents.damage
    available = ", ".join(sorted(f"{topic.name} ({topic.type})" for topic in contents.topics)) or "nothing"
    return messages.tables(f"no topic has a supported type ({', '.join(KINDS)}). The bag contains: {available}")


def files_of(path: Path) -> list[Path]:
    """Return the files of a bag; of a folder those whose names end as those of a bag."""
    files = [path] if path.is_file() else [file for file in path.iterdir() if file.name.endswith(ENDINGS)]
    return sorted(files, key=natural_order)


def _add_messages(file: Path, messages: MessageTables, contents: BagContents) -> None:
    types, unreadable = dict[BagTopic, Typestore | None](), Counter[str]()
    for topic, received, raw in stored_messages(file, KINDS, contents):
        if topic.name == FIXED:
            continue
        if topic not in types:
            types[topic] = _types_or_none(topic, contents)
        if (store := types[topic]) is None:
            continue
        try:
            decode = store.deserialize_ros1 if topic.encoding == ROS1 else store.deserialize_cdr
            message: Any = decode(raw, topic.type)
        except MemoryError:
            raise
        except Exception as error:  # generated code raises many types on damaged messages
            unreadable[f"{topic.name} cannot be decoded as {topic.type} ({type(error).__name__}: {error})"] += 1
            continue
        kind = KINDS[topic.type]
        kind = kind._replace(rank=kind.rank - (topic.name in FIRST))
        parts: Sequence[Any] = getattr(message, "transforms", (message,))  # TF: a table for each frame
        for part in parts:
            frames = f":{part.header.frame_id}:{part.child_frame_id}" if part is not message else ""
            fields = _numbers(part if part is message else part.transform)
            messages.add(topic.name + frames, kind, fields, _stamp(part) or received, received)
    if unreadable:
        contents.damage.append(f"{unreadable.total()} messages are left out: {next(iter(unreadable))}")


def _types_or_none(topic: BagTopic, contents: BagContents) -> Typestore | None:
    """Return the message types of a topic, or None if its definition is damaged."""
    try:
        return _types_of(topic.type, topic.definition, topic.idl)
    except MemoryError:
        raise
    except Exception as error:  # the parser of definitions raises many types
        contents.damage.append(f"{topic.name} is left out: its definition of {topic.type} is damaged ({error})")
        return None


@lru_cache(32)  # the topics and files of a bag repeat their definitions, and each store compiles code for its types
def _types_of(kind: str, definition: str, idl: bool) -> Typestore:
    """Return the message types that a bag defines, or those of the latest ROS 2 if the bag defines none."""
    if not definition:
        return get_typestore(Stores.LATEST)
    types = get_typestore(Stores.EMPTY)
    if not idl:
        types.register(get_types_from_msg(definition, kind))
        return types
    for part in definition.split("=" * 80 + "\n"):
        types.register(get_types_from_idl(part.partition("\n")[2] if part.startswith("IDL: ") else part))
    return types


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

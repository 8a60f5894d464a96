"""Small logs of every format that Brakeline reads, to mutate: one drive of some seconds, a few kB each."""

from __future__ import annotations

import struct
from collections.abc import Callable
from pathlib import Path

import numpy as np
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Writer2
from rosbags.typesys import Stores, get_typestore

from brakeline.actors.mavlink.ardupilot_dialect import mavlink as dialect
from tests.deploy.data.bags import EPOCH, write_bin, write_json_lines, write_parquet, write_text_log
from tests.deploy.data.porter import drive, write_csv
from tests.logs.sample_log import Writer

DRIVE = tuple(values[::5] for values in drive(seconds=5.0, seed=2))  # ten rows a second
QUICK = tuple(values[:30] for values in DRIVE)


def _messages(bag, types, serialize) -> None:
    """Poses and commands: their definitions are short, so that most mutations hit the messages."""
    kind = {name: types.types[f"{package}/msg/{name}"] for package, name in KINDS}
    stamped = bag.add_connection("/pose", "geometry_msgs/msg/PoseStamped", typestore=types)
    command = bag.add_connection("/cmd_vel", "geometry_msgs/msg/Twist", typestore=types)
    first = {"seq": 1} if "seq" in kind["Header"].__dataclass_fields__ else {}
    for t, (x, y, heading, _, _, speed, turn) in zip(*QUICK, strict=True):
        now = EPOCH + round(1e9 * t)
        header = kind["Header"](**first, stamp=kind["Time"](*divmod(now, 10**9)), frame_id="odom")
        attitude = kind["Quaternion"](0.0, 0.0, np.sin(heading / 2), np.cos(heading / 2))
        pose = kind["PoseStamped"](header, kind["Pose"](kind["Point"](x, y, 0.0), attitude))
        twist = kind["Twist"](kind["Vector3"](speed, 0.0, 0.0), kind["Vector3"](0.0, 0.0, turn))
        bag.write(stamped, now, serialize(pose, pose.__msgtype__))
        bag.write(command, now, serialize(twist, twist.__msgtype__))


KINDS = [("std_msgs", "Header"), ("builtin_interfaces", "Time")]
KINDS += [("geometry_msgs", name) for name in ("Quaternion", "Point", "Pose", "PoseStamped", "Vector3", "Twist")]


def ros1_bag(path: Path) -> Path:
    types = get_typestore(Stores.ROS1_NOETIC)
    with Writer1(path) as bag:
        _messages(bag, types, types.serialize_ros1)
    return path


def ros2_bag(path: Path) -> Path:
    """A bag's file alone, without its folder."""
    types = get_typestore(Stores.ROS2_HUMBLE)
    storage = StoragePlugin.MCAP if path.suffix == ".mcap" else StoragePlugin.SQLITE3
    folder = path.with_suffix("")
    with Writer2(folder, version=9, storage_plugin=storage) as bag:
        _messages(bag, types, types.serialize_cdr)
    return (folder / path.name).rename(path)


def tlog(path: Path) -> Path:
    vehicle, out = dialect.MAVLink(None, srcSystem=1, srcComponent=1), bytearray()
    for t, (x, y, heading, v, w, speed, turn) in zip(*QUICK, strict=True):
        ms, stamp = round(1e3 * t), struct.pack(">Q", 1_760_000_000_000_000 + round(1e6 * t))
        north, east = v * np.sin(heading), v * np.cos(heading)
        for message in (
            dialect.MAVLink_local_position_ned_message(ms, y, x, 0.0, north, east, 0.0),
            dialect.MAVLink_attitude_message(ms, 0.0, 0.0, np.pi / 2 - heading, 0.0, 0.0, -w),
            dialect.MAVLink_scaled_imu_message(ms, 10, 20, -1000, 0, 0, 0, 0, 0, 0),
            dialect.MAVLink_set_position_target_local_ned_message(
                *(ms, 1, 1, dialect.MAV_FRAME_BODY_NED, 0b011111000111, 0.0, 0.0, 0.0),
                *(speed, 0.0, 0.0),
                *[0.0] * 4,
                -turn,
            ),
        ):
            out += stamp + message.pack(vehicle)
    path.write_bytes(out)
    return path


def ulog(path: Path) -> Path:
    """A PX4 log, byte by byte: formats, subscriptions and data."""
    out = bytearray(b"ULog\x01\x12\x35\x01" + struct.pack("<Q", 0))

    def add(kind: str, body: bytes) -> None:
        out.extend(struct.pack("<HB", len(body), ord(kind)) + body)

    position = ("x", "y", "z", "vx", "vy", "vz", "ax", "ay", "az", "heading")
    formats = {
        "vehicle_local_position": "".join(f"float {name};" for name in position),
        "vehicle_angular_velocity": "float[3] xyz;",
        "trajectory_setpoint": "float[3] velocity;float yawspeed;",
    }
    add("B", bytes(40))
    for name, fields in formats.items():
        add("F", f"{name}:uint64_t timestamp;{fields}".encode())
    for number, name in enumerate(formats):
        add("A", struct.pack("<BH", 0, number) + name.encode())
    for t, (x, y, heading, v, w, speed, turn) in zip(*QUICK, strict=True):
        north, east, now = v * np.sin(heading), v * np.cos(heading), 10_000_000 + round(1e6 * t)
        values = (y, x, 0.0, north, east, *[0.0] * 4, np.pi / 2 - heading)
        add("D", struct.pack("<HQ10f", 0, now, *values))
        add("D", struct.pack("<HQ3f", 1, now, 0.0, 0.0, -w))
        add("D", struct.pack("<HQ4f", 2, now, speed, 0.0, 0.0, -turn))
    path.write_bytes(out)
    return path


def run_log(path: Path) -> Path:
    writer = Writer(seed=3, losses=0.0)
    while len(writer.entries) < 20:
        writer.entries.clear()
        writer.episode("actor-0", 0)
    return writer.write(path)


# For each format: the file's ending and how to write it.
SEEDS: dict[str, tuple[str, Callable[[Path], Path]]] = {
    "csv": (".csv", lambda path: write_csv(path, *DRIVE)),
    "jsonl": (".jsonl", lambda path: write_json_lines(path, *DRIVE)),
    "parquet": (".parquet", lambda path: write_parquet(path, *DRIVE)),
    "ros2-db3": (".db3", ros2_bag),
    "ros2-mcap": (".mcap", ros2_bag),
    "ros1": (".bag", ros1_bag),
    "tlog": (".tlog", tlog),
    "dataflash-bin": (".bin", lambda path: write_bin(path, *QUICK)),
    "dataflash-log": (".log", lambda path: write_text_log(path, *QUICK)),
    "ulog": (".ulg", ulog),
    "run-mcap": (".mcap", run_log),
}


def seed(kind: str, folder: Path) -> Path:
    """Write the log of a format into a folder."""
    ending, write = SEEDS[kind]
    return write(folder / f"seed{ending}")

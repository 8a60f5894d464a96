"""Bags and logs written by others' writers, or byte by byte, with what `porter.drive` gives."""

import json
import math
import struct

import numpy as np
import pyarrow
import pyarrow.parquet
from pymavlink import DFReader
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

from tests.deploy.data.porter import COLUMNS

ODOMETRY = {"/odom": 0.0}
EPOCH = 1_760_000_000_123_456_789  # ns


def write_parquet(path, time, values):
    columns = {"time": time} | dict(zip(COLUMNS, values.T, strict=True)) | {"note": ["a"] * len(time)}
    pyarrow.parquet.write_table(pyarrow.table(columns), path)
    return path


def write_parquet_folder(path, time, values):
    """Twelve parts, as programs for large data write them: part-2 comes before part-10."""
    path.mkdir()
    for i, rows in enumerate(np.array_split(np.arange(len(time)), 12)):
        write_parquet(path / f"part-{i}.parquet", time[rows], values[rows])
    (path / "_SUCCESS").touch()
    return path


def write_json_lines(path, time, values):
    """One object a line, with text that no column holds."""
    rows = [
        {"time": float(t), **dict(zip(COLUMNS, map(float, row), strict=True))}
        for t, row in zip(time, values, strict=True)
    ]
    path.write_text("".join(json.dumps(row | {"note": "a"}) + "\n" for row in rows))
    return path


def write_bag(path, time, values, storage=StoragePlugin.SQLITE3, odometry=ODOMETRY):
    """A ROS 2 bag."""
    types = get_typestore(Stores.ROS2_HUMBLE)
    with Writer(path, version=9, storage_plugin=storage) as bag:
        write_messages(bag, types, types.serialize_cdr, time, values, odometry)
    return path


def write_ros1_bag(path, time, values, compression=None):
    types = get_typestore(Stores.ROS1_NOETIC)
    bag = Writer1(path)
    bag.chunk_threshold = 2**16  # bytes: several chunks, as in long bags
    if compression is not None:
        bag.set_compression(compression)
    with bag:
        write_messages(bag, types, types.serialize_ros1, time, values)
    return path


def write_messages(bag, types, serialize, time, values, odometry=ODOMETRY):
    """/odom with a header, /cmd_vel without; positions in the world, velocities of the body.

    odometry: topics of odometry, and how far x is off in each [m].
    """

    def kind(name):
        return types.types[name.replace("/", "/msg/")]

    vector, quaternion, point, pose, twist = (
        kind(f"geometry_msgs/{name}") for name in ("Vector3", "Quaternion", "Point", "Pose", "Twist")
    )
    posed, twisted = (kind(f"geometry_msgs/{name}WithCovariance") for name in ("Pose", "Twist"))
    state, text = kind("nav_msgs/Odometry"), kind("std_msgs/String")
    header, stamp, none = kind("std_msgs/Header"), kind("builtin_interfaces/Time"), np.zeros(36)
    first = {"seq": 7} if "seq" in header.__dataclass_fields__ else {}  # of ROS 1
    kinds = {**dict.fromkeys(odometry, state), "/cmd_vel": twist, "/chatter": text}
    topics = {name: bag.add_connection(name, kind.__msgtype__, typestore=types) for name, kind in kinds.items()}

    def write(topic, message, at):
        bag.write(topics[topic], at, serialize(message, message.__msgtype__))

    write("/chatter", text("hello"), EPOCH)
    last = None
    for t, (x, y, heading, v, w, speed, turn) in zip(time, values, strict=True):
        now = EPOCH + round(1e9 * t)
        q = quaternion(0.0, 0.0, math.sin(heading / 2), math.cos(heading / 2))
        moved = twisted(twist(vector(v, 0.0, 0.0), vector(0.0, 0.0, w)), none)
        stamped = header(**first, stamp=stamp(*divmod(now, 1_000_000_000)), frame_id="odom")
        for topic, off in odometry.items():
            message = state(stamped, "base_link", posed(pose(point(x + off, y, 0.0), q), none), moved)
            write(topic, message, now + 3_000_000)  # received a little later
        if (speed, turn) != last or round(t / 0.02) % 5 == 0:
            write("/cmd_vel", twist(vector(speed, 0.0, 0.0), vector(0.0, 0.0, turn)), now)
            last = speed, turn


def write_text_log(path, time, values):
    """A rover's log as text, as ground stations write it from a .bin: the scaled values of each message."""
    log = DFReader.DFReader_binary(str(write_bin(path.with_suffix(".bin"), time, values)))
    lines = [
        f"FMT, {one.type}, {one.len}, {one.name}, {one.format}, {','.join(one.columns)}" for one in log.formats.values()
    ]
    while (message := log.recv_match(type=["XKF1", "IMU", "THR", "STER"])) is not None:
        lines.append(", ".join([message.get_type(), *(repr(value) for value in list(message.to_dict().values())[1:])]))
    log.close()
    path.write_text("\n".join(lines) + "\n")
    return path


def write_bin(path, time, values):
    """A rover's log, as ArduPilot writes it: FMT messages, then XKF1, IMU, THR, STER."""
    kinds = {
        "XKF1": (10, "QBffffffffff", "TimeUS,C,Roll,Pitch,Yaw,VN,VE,VD,dPD,PN,PE,PD"),
        "IMU": (11, "QBffffff", "TimeUS,I,GyrX,GyrY,GyrZ,AccX,AccY,AccZ"),
        "THR": (12, "Qf", "TimeUS,DesSpeed"),
        "STER": (13, "Qf", "TimeUS,DesTurnRate"),
    }
    with path.open("wb") as file:

        def write(number, form, *given):
            file.write(struct.pack("<BBB", 0xA3, 0x95, number) + struct.pack("<" + form, *given))

        def declare(number, length, name, form, columns):
            write(128, "BB4s16s64s", number, length, name.encode(), form.encode(), columns.encode())

        declare(128, 89, "FMT", "BBnNZ", "Type,Length,Name,Format,Columns")
        for name, (number, form, columns) in kinds.items():
            declare(number, 3 + struct.calcsize("<" + form), name, form, columns)
        for t, (x, y, heading, v, w, speed, turn) in zip(time, values, strict=True):
            us = 1_000_000 + round(1e6 * t)
            yaw = math.degrees(math.pi / 2 - heading)
            vx, vy = v * math.cos(heading), v * math.sin(heading)
            write(10, kinds["XKF1"][1], us, 0, 0, 0, yaw, vy, vx, 0, 0, y, x, 0)
            write(10, kinds["XKF1"][1], us, 1, 0, 0, 0, 9, 9, 9, 9, 9, 9, 9)  # another core
            write(11, kinds["IMU"][1], us, 0, 0.0, 0.0, -w, 0.0, 0.0, -9.8)
            write(12, "Qf", us, speed)
            write(13, "Qf", us, -math.degrees(turn))
    return path

"""Bags and logs written by others' writers, or byte by byte, with what `porter.drive` gives."""

import math
import struct

import numpy as np
import pyarrow
import pyarrow.parquet
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

from tests.deploy.data.porter import COLUMNS

EPOCH = 1_760_000_000_123_456_789  # ns


def write_parquet(path, time, values):
    columns = {"time": time} | dict(zip(COLUMNS, values.T, strict=True)) | {"note": ["a"] * len(time)}
    pyarrow.parquet.write_table(pyarrow.table(columns), path)
    return path


def write_bag(path, time, values, storage=StoragePlugin.SQLITE3):
    """/odom with a header, /cmd_vel without; positions in the world, velocities of the body."""
    types = get_typestore(Stores.ROS2_HUMBLE)

    def kind(name):
        return types.types[name.replace("/", "/msg/")]

    vector, quaternion, point, pose, twist = (
        kind(f"geometry_msgs/{name}") for name in ("Vector3", "Quaternion", "Point", "Pose", "Twist")
    )
    posed, twisted = (kind(f"geometry_msgs/{name}WithCovariance") for name in ("Pose", "Twist"))
    odometry, text = kind("nav_msgs/Odometry"), kind("std_msgs/String")
    header, stamp, none = kind("std_msgs/Header"), kind("builtin_interfaces/Time"), np.zeros(36)
    with Writer(path, version=9, storage_plugin=storage) as bag:
        kinds = {"/odom": odometry, "/cmd_vel": twist, "/chatter": text}
        topics = {name: bag.add_connection(name, kind.__msgtype__, typestore=types) for name, kind in kinds.items()}

        def write(topic, message, at):
            bag.write(topics[topic], at, types.serialize_cdr(message, message.__msgtype__))

        write("/chatter", text("hello"), EPOCH)
        last = None
        for t, (x, y, heading, v, w, speed, turn) in zip(time, values, strict=True):
            now = EPOCH + round(1e9 * t)
            q = quaternion(0.0, 0.0, math.sin(heading / 2), math.cos(heading / 2))
            moved = twisted(twist(vector(v, 0.0, 0.0), vector(0.0, 0.0, w)), none)
            stamped = header(stamp(*divmod(now, 1_000_000_000)), "odom")
            message = odometry(stamped, "base_link", posed(pose(point(x, y, 0.0), q), none), moved)
            write("/odom", message, now + 3_000_000)  # received a little later
            if (speed, turn) != last or round(t / 0.02) % 5 == 0:
                write("/cmd_vel", twist(vector(speed, 0.0, 0.0), vector(0.0, 0.0, turn)), now)
                last = speed, turn
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

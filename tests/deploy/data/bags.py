"""Bags and logs written by others' writers, or byte by byte, with what `porter.drive` gives."""

import math
import struct

import numpy as np
import pyarrow
import pyarrow.parquet
from pymavlink.dialects.v20 import ardupilotmega as mavlink
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
    kinds = types.types
    vector, quaternion = kinds["geometry_msgs/msg/Vector3"], kinds["geometry_msgs/msg/Quaternion"]
    point, pose, twist = (kinds[f"geometry_msgs/msg/{n}"] for n in ("Point", "Pose", "Twist"))
    posed, twisted = (kinds[f"geometry_msgs/msg/{n}WithCovariance"] for n in ("Pose", "Twist"))
    header, stamp = kinds["std_msgs/msg/Header"], kinds["builtin_interfaces/msg/Time"]
    odometry, text = kinds["nav_msgs/msg/Odometry"], kinds["std_msgs/msg/String"]
    none = np.zeros(36)
    with Writer(path, version=9, storage_plugin=storage) as bag:
        topics = {
            name: bag.add_connection(name, kind, typestore=types)
            for name, kind in (
                ("/odom", odometry.__msgtype__),
                ("/cmd_vel", twist.__msgtype__),
                ("/chatter", text.__msgtype__),
            )
        }

        def write(topic, message, at):
            bag.write(topics[topic], at, types.serialize_cdr(message, message.__msgtype__))

        write("/chatter", text("hello"), EPOCH)
        last = None
        for t, (x, y, heading, v, w, speed, turn) in zip(time, values, strict=True):
            now = EPOCH + round(1e9 * t)
            seconds, rest = divmod(now, 1_000_000_000)
            q = quaternion(0.0, 0.0, math.sin(heading / 2), math.cos(heading / 2))
            moved = twist(vector(v, 0.0, 0.0), vector(0.0, 0.0, w))
            place = posed(pose(point(x, y, 0.0), q), none)
            message = odometry(header(stamp(seconds, rest), "odom"), "base_link", place, twisted(moved, none))
            write("/odom", message, now + 3_000_000)  # received a little later
            if (speed, turn) != last or round(t / 0.02) % 5 == 0:
                write("/cmd_vel", twist(vector(speed, 0.0, 0.0), vector(0.0, 0.0, turn)), now)
                last = speed, turn
    return path


def write_tlog(path, time, values):
    """A vehicle that is told velocities in the world: x, y, vx, vy in, NED out."""
    link = mavlink.MAVLink(None, srcSystem=1)
    with path.open("wb") as file:
        for t, (x, y, vx, vy, ux, uy) in zip(time, values, strict=True):
            ms = round(1000 * t)
            local = link.local_position_ned_encode(ms, y, x, -1.0, vy, vx, 0.0)
            told = link.set_position_target_local_ned_encode(ms, 1, 1, 1, 0x0DC7, 0, 0, 0, uy, ux, 0, 0, 0, 0, 0, 0)
            for message in (local, told):
                file.write(struct.pack(">Q", 1_760_000_000_000_000 + 1000 * ms) + message.pack(link))
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


def write_ulg(path, time, values):
    """A quadrotor's log, as PX4 writes it, of x, y, vx, vy and the setpoints ux, uy."""
    forms = {
        "vehicle_local_position": (
            "uint64_t timestamp;" + "".join(f"float {n};" for n in ["x", "y", "z", "vx", "vy", "vz"])
        ),
        "trajectory_setpoint": "uint64_t timestamp;float[3] velocity;",
    }
    with path.open("wb") as file:
        file.write(b"ULog\x01\x12\x35\x01" + struct.pack("<Q", 0))

        def write(kind, payload):
            file.write(struct.pack("<HB", len(payload), ord(kind)) + payload)

        write("B", bytes(40))
        for name, form in forms.items():
            write("F", f"{name}:{form}".encode())
        for number, name in enumerate(forms):
            write("A", struct.pack("<BH", 0, number) + name.encode())
        for t, (x, y, vx, vy, ux, uy) in zip(time, values, strict=True):
            us = 1_000_000 + round(1e6 * t)
            write("D", struct.pack("<HQ6f", 0, us, y, x, -1.0, vy, vx, 0.0))
            write("D", struct.pack("<HQ3f", 1, us, uy, ux, 0.0))
    return path

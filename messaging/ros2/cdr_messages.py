"""Encode and decode ROS 2 messages (CDR), and return their type hashes and definitions. This needs no ROS installation.

The types are those of Jazzy. The types that we use have the same hashes in Kilted (a test compares them).
"""

from __future__ import annotations

import math
from functools import cache
from typing import Any, TypeVar

from rosbags.serde import SerdeError
from rosbags.typesys.store import Typestore
from rosbags.typesys.stores import ros2_jazzy as types

from brakeline.errors import Malformed

M = TypeVar("M")

LONGEST = 100_000  # elements of a sequence in a received message

CompressedImage = types.sensor_msgs__msg__CompressedImage
Clock = types.rosgraph_msgs__msg__Clock
DiagnosticArray = types.diagnostic_msgs__msg__DiagnosticArray
DiagnosticStatus = types.diagnostic_msgs__msg__DiagnosticStatus
KeyValue = types.diagnostic_msgs__msg__KeyValue
LaserScan = types.sensor_msgs__msg__LaserScan
Marker = types.visualization_msgs__msg__Marker
MarkerArray = types.visualization_msgs__msg__MarkerArray
MeshFile = types.visualization_msgs__msg__MeshFile
Odometry = types.nav_msgs__msg__Odometry
PoseWithCovariance = types.geometry_msgs__msg__PoseWithCovariance
TFMessage = types.tf2_msgs__msg__TFMessage
Transform = types.geometry_msgs__msg__Transform
TransformStamped = types.geometry_msgs__msg__TransformStamped
Twist = types.geometry_msgs__msg__Twist
TwistStamped = types.geometry_msgs__msg__TwistStamped
TwistWithCovariance = types.geometry_msgs__msg__TwistWithCovariance
ColorRGBA = types.std_msgs__msg__ColorRGBA
Duration = types.builtin_interfaces__msg__Duration
Header = types.std_msgs__msg__Header
Point = types.geometry_msgs__msg__Point
Pose = types.geometry_msgs__msg__Pose
Quaternion = types.geometry_msgs__msg__Quaternion
Time = types.builtin_interfaces__msg__Time
Vector3 = types.geometry_msgs__msg__Vector3

STORE = Typestore(types, max_sequence_length=LONGEST)


def type_of(kind: type) -> str:
    """Return the name of a message type, such as `geometry_msgs/msg/Twist`."""
    return str(kind.__msgtype__)  # type: ignore[attr-defined]


@cache
def digest_of(kind: type) -> str:
    """Return the hash of a message type, `RIHS01_…`."""
    return str(STORE.hash_rihs01(type_of(kind)))


@cache
def definition_of(kind: type) -> str:
    """Return the definition of a type and of the types that it contains, as a bag's schema needs it."""
    return str(STORE.generate_msgdef(type_of(kind), ros_version=2)[0])


def encode(message: Any) -> bytes:
    """Encode a message in little-endian CDR, with its encapsulation header."""
    return bytes(STORE.serialize_cdr(message, type_of(type(message)), little_endian=True))


def decode(kind: type[M], payload: bytes) -> M:
    """Decode a message of one type. Raises Malformed: the bytes are not a message of that type."""
    try:
        message = STORE.deserialize_cdr(payload, type_of(kind))
    except (SerdeError, AssertionError, IndexError, OverflowError, MemoryError) as error:
        raise Malformed(f"not a {type_of(kind)}: {error}") from error
    assert isinstance(message, kind)
    return message


def time_of(seconds: float) -> Time:
    """Convert seconds to a ROS time."""
    nanoseconds = round(seconds * 1e9)
    return Time(sec=nanoseconds // 10**9, nanosec=nanoseconds % 10**9)


def seconds(time: Time) -> float:
    """Convert a ROS time to seconds."""
    return float(time.sec + 1e-9 * time.nanosec)


def header(at: float, frame: str) -> Header:
    """Return a header with a time [s] and a frame."""
    return Header(stamp=time_of(at), frame_id=frame)


def quaternion(yaw: float) -> Quaternion:
    """Return a rotation about the vertical axis [rad]."""
    return Quaternion(x=0.0, y=0.0, z=math.sin(0.5 * yaw), w=math.cos(0.5 * yaw))


def yaw_of(q: Quaternion) -> float:
    """Return the angle about the vertical axis [rad]; NaN if the quaternion is not a rotation."""
    norm = q.x * q.x + q.y * q.y + q.z * q.z + q.w * q.w
    if not 0.9 < norm < 1.1:
        return math.nan
    return math.atan2(2.0 * (q.w * q.z + q.x * q.y), norm - 2.0 * (q.y * q.y + q.z * q.z))


def vector(x: float = 0.0, y: float = 0.0, z: float = 0.0) -> Vector3:
    """Return a vector."""
    return Vector3(x=x, y=y, z=z)


def point(x: float, y: float, z: float = 0.0) -> Point:
    """Return a point."""
    return Point(x=x, y=y, z=z)


def pose(x: float, y: float, yaw: float = 0.0, z: float = 0.0) -> Pose:
    """Return a pose that is level."""
    return Pose(position=point(x, y, z), orientation=quaternion(yaw))


def twist(speed: float, turn_rate: float) -> Twist:
    """Return the command of a speed [m/s] and a turn rate [rad/s]."""
    return Twist(linear=vector(speed), angular=vector(z=turn_rate))

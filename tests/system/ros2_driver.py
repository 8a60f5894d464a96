"""A ROS 2 node by somebody else's implementation (zenoh-ros2-sdk): rams what its scan shows, through topics alone.

python ros2_driver.py PORT [--direct]. It turns to the nearest hit of /scan in a direction, drives at
it at full speed, and after a while picks another direction. On stdout, a JSON object every half second: how many raw
commands, scans and commands went by, and how long [s] raw commands took to come out of /cmd_vel. --direct: it commands
the base itself, with nothing between. Run it with a HOME of its own: the SDK may edit git's configuration.
"""

from __future__ import annotations

import json
import math
import random
import sys
import threading
import time

import numpy as np
from rosbags.typesys import Stores, get_typestore
from zenoh_ros2_sdk import ROS2Publisher, ROS2Subscriber
from zenoh_ros2_sdk.session import ZenohSession

PORT = int(sys.argv[1])
RAW = "/cmd_vel" if "--direct" in sys.argv else "/cmd_vel_raw"
PERSISTENCE = 40  # scans that one thing is rammed for, or driven away from
PAUSE = 0.02  # s between raw commands
FASTEST_TURN = 0.498  # rad/s; each command adds up to 0.001 of its own, and the filter clips commands above 0.5

STORE = get_typestore(Stores.ROS2_JAZZY)


def definition(name: str) -> str:
    """The text of one type's .msg: the SDK would fetch it with git."""
    return STORE.generate_msgdef(name, ros_version=2)[0].split("=" * 80)[0]


def register(*names: str) -> None:
    session = ZenohSession.get_instance("127.0.0.1", PORT)
    for name in names:
        session.register_message_type(definition(name), name)


def digest(name: str) -> str:
    return STORE.hash_rihs01(name)


class Driver:
    def __init__(self) -> None:
        self.rng = random.Random(1)
        self.scans = self.heard = 0
        self.wanted = (0.0, 0.0)
        self.aim = 0.0  # rad in the scan's frame, of what is rammed
        self.sent: dict[float, float] = {}  # by turn rate, rounded: when a raw command was sent that has not come out
        self.delays: list[float] = []
        self.lock = threading.Lock()

    def scan(self, message: object) -> None:
        ranges = np.asarray(message.ranges, float)
        ranges = np.where(np.isfinite(ranges), ranges, 9.0)
        angles = message.angle_min + message.angle_increment * np.arange(len(ranges))
        angles = (angles + math.pi) % (2.0 * math.pi) - math.pi
        self.scans += 1
        if self.scans % PERSISTENCE == 1:
            self.aim = self.rng.uniform(-2.0, 2.0)
        off = np.abs((angles - self.aim + math.pi) % (2.0 * math.pi) - math.pi)
        if self.scans // PERSISTENCE % 2:  # away, to where there is most room; what is beside the way is in the way
            room = np.array([np.roll(ranges, k) for k in range(-15, 16)]).min(axis=0)
            target = angles[np.argmax(np.where(off < 1.5, room, 0.0))]
        else:  # the nearest thing where it looks; it keeps aiming at it as it turns
            target = angles[np.argmin(np.where(off < 0.6, ranges, 99.0))]
        turn = max(-FASTEST_TURN, min(FASTEST_TURN, 2.0 * target))
        self.aim = target - 0.2 * turn
        with self.lock:
            self.wanted = (0.25 if abs(target) < 0.5 else 0.0, turn)

    def command(self, message: object) -> None:
        with self.lock:
            self.heard += 1
            sent = self.sent.pop(round(message.angular.z, 8), None)
            if sent is not None:
                self.delays.append(time.monotonic() - sent)


def main() -> None:
    register(
        "builtin_interfaces/msg/Time", "std_msgs/msg/Header", "geometry_msgs/msg/Vector3", "geometry_msgs/msg/Twist"
    )
    driver = Driver()
    kind = "geometry_msgs/msg/Twist"
    place = {"router_ip": "127.0.0.1", "router_port": PORT, "domain_id": 0}
    _scans = ROS2Subscriber(
        "/scan",
        "sensor_msgs/msg/LaserScan",
        driver.scan,
        definition("sensor_msgs/msg/LaserScan"),
        type_hash=digest("sensor_msgs/msg/LaserScan"),
        **place,
    )
    _commands = ROS2Subscriber("/cmd_vel", kind, driver.command, definition(kind), type_hash=digest(kind), **place)
    raw = ROS2Publisher(RAW, kind, definition(kind), node_name="rammer", type_hash=digest(kind), **place)
    vector = raw.session_mgr.store.types["geometry_msgs/msg/Vector3"]
    reported = time.monotonic()
    number = 0
    while True:
        number += 1
        with driver.lock:
            speed, turn = driver.wanted
            turn += 1e-6 * (number % 1000)  # each command can be told from the others
            driver.sent[round(turn, 8)] = time.monotonic()
        raw.publish(linear=vector(x=speed, y=0.0, z=0.0), angular=vector(x=0.0, y=0.0, z=turn))
        if time.monotonic() - reported > 0.5:
            reported = time.monotonic()
            with driver.lock:
                figures = {"raw": number, "scans": driver.scans, "commands": driver.heard}
                figures["delays"] = driver.delays[-200:]
            print(json.dumps(figures), flush=True)
        time.sleep(PAUSE)


if __name__ == "__main__":
    main()

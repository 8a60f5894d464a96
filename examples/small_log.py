"""Make a small log of a robot for the examples. The robot drives at random, and sometimes stops."""

import csv
import math
import random
from pathlib import Path

STEP = 0.05  # s between rows: shorter than the robot's period, so that the log shows the path within a period
DESCRIPTION = """
name = "my-robot"
period = 0.2
sight = 2.0

[state]
x = { unit = "m", role = "position", error = 0.01 }
y = { unit = "m", role = "position", error = 0.01 }
heading = { unit = "rad", role = "heading", error = 0.01 }
v = { unit = "m/s", error = 0.02, follows = "speed" }
w = { unit = "rad/s", error = 0.03, follows = "turn rate" }

[input]
speed = { unit = "m/s", low = 0.0, high = 0.4, moves = true }
"turn rate" = { unit = "rad/s", low = -1.0, high = 1.0, moves = false }

[plan]
horizon = 3
brake = 2

[[body]]
at = [0.0, 0.0]
radius = 0.15
"""


def drive(seconds=700.0, seed=0):
    """Return rows (time, x, y, heading, v, w, speed, turn rate)."""
    rng = random.Random(seed)
    x = y = heading = v = w = speed = turn = 0.0
    rows, periods_of_rest, target = [], 0, (0.2, 0.0)
    for k in range(round(seconds / STEP)):
        if k % 4 == 0:  # a command each period
            if rng.random() < 0.15:
                target = rng.uniform(-0.1, 0.5), rng.uniform(-1.3, 1.3)
                periods_of_rest = 8 if rng.random() < 0.3 else 0
            share = rng.choice((0.2, 0.6, 1.0))  # of the change towards the target in this period
            speed += share * (min(max(target[0], 0.0), 0.4) - speed)
            turn += share * (min(max(target[1], -1.0), 1.0) - turn)
            if periods_of_rest:
                speed, turn, periods_of_rest = 0.0, 0.0, periods_of_rest - 1
        noisy = [value + rng.uniform(-0.003, 0.003) for value in (x, y, heading, v, w)]
        rows.append((k * STEP, *noisy, speed, turn))
        for _ in range(5):
            v, w = v + 0.2 * (speed - v), w + 0.2 * (turn - w)
            heading += 0.01 * w
            x, y = x + 0.01 * v * math.cos(heading), y + 0.01 * v * math.sin(heading)
    return rows


def write_csv(path: Path) -> Path:
    """Write the log as CSV."""
    with path.open("w", newline="") as file:
        out = csv.writer(file)
        out.writerow(("time", "x", "y", "heading", "v", "w", "speed", "turn rate"))
        out.writerows(drive())
    return path


def write_bag(path: Path) -> Path:
    """Write the log as a ROS 2 bag with /odom (nav_msgs/Odometry) and /cmd_vel (geometry_msgs/Twist)."""
    import numpy as np
    from rosbags.rosbag2 import StoragePlugin, Writer
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS2_HUMBLE)
    kind = {name.rsplit("/", 1)[1]: message for name, message in store.types.items() if "/msg/" in name}
    Vector, Twist, Pose, Point = kind["Vector3"], kind["Twist"], kind["Pose"], kind["Point"]
    covariance = np.zeros(36)
    with Writer(path, version=9, storage_plugin=StoragePlugin.MCAP) as bag:
        odom = bag.add_connection("/odom", "nav_msgs/msg/Odometry", typestore=store)
        commands = bag.add_connection("/cmd_vel", "geometry_msgs/msg/Twist", typestore=store)
        for time, x, y, heading, v, w, speed, turn in drive():
            now = 1_700_000_000_000_000_000 + round(1e9 * time)
            seconds, rest = divmod(now, 1_000_000_000)
            attitude = kind["Quaternion"](0.0, 0.0, math.sin(heading / 2), math.cos(heading / 2))
            pose = kind["PoseWithCovariance"](Pose(Point(x, y, 0.0), attitude), covariance)
            velocity = kind["TwistWithCovariance"](Twist(Vector(v, 0.0, 0.0), Vector(0.0, 0.0, w)), covariance)
            stamp = store.types["builtin_interfaces/msg/Time"](seconds, rest)
            header = store.types["std_msgs/msg/Header"](stamp, "odom")
            message = kind["Odometry"](header, "base_link", pose, velocity)
            bag.write(odom, now, store.serialize_cdr(message, "nav_msgs/msg/Odometry"))
            command = Twist(Vector(speed, 0.0, 0.0), Vector(0.0, 0.0, turn))
            bag.write(commands, now, store.serialize_cdr(command, "geometry_msgs/msg/Twist"))
    return path

"""Check that a scan fits the robot, and was taken where the robot can have been: elsewhere, other space is free."""

from __future__ import annotations

import math

import numpy as np

from brakeline.errors import BadRequest
from brakeline.messaging.labels import split_label
from brakeline.messaging.robot import Array, Robot
from brakeline.messaging.scan import MAX_SCAN_AGE, Scan
from brakeline.messaging.sensor_messages import RangeMeasurement


def check_scan(robot: Robot, state: Array, measurement: RangeMeasurement) -> None:
    """Check that a scan, or a range image, is of the robot's world, and comes from a pose near its measured state (n,).

    Raises:
        BadRequest: the robot has no such sensor, or cannot have come from the pose to the state.
    """
    if isinstance(measurement, Scan) and (robot.position_dim != 2 or robot.heading is None):
        raise BadRequest("scan", f"a {robot.name} robot has no fan in the plane: give obstacles, or a range image")
    if not isinstance(measurement, Scan) and robot.position_dim != 3:
        raise BadRequest("image", f"a {robot.name} robot has no range image in space: give obstacles, or a scan")
    if measurement.age <= MAX_SCAN_AGE:  # an older one shows no free space
        _check_pose(robot, state, measurement)


def _check_pose(robot: Robot, state: Array, measurement: RangeMeasurement) -> None:
    """Check that the robot can have come from the pose of a measurement to its measured state (n,).

    A measurement that is older than `MAX_SCAN_AGE` shows no free space, so the robot has that time for its way. The
    stated age does not count, because it may be 0 in a world in which nothing moves. If no input is a speed in m/s (a
    turn rate in rad/s), the robot's largest one is not known, and every position (heading) passes.

    Raises:
        BadRequest: the robot cannot have come so far.
    """
    d = robot.position_dim
    name, pose = ("scan", measurement.pose) if isinstance(measurement, Scan) else ("image", measurement.at)
    away = float(np.linalg.norm(np.subtract(pose[:d], state[:d])))
    noise = measurement.position_error + 2.0 * float(np.linalg.norm(robot.measurement_bound[:d]))
    if away > (most := noise + MAX_SCAN_AGE * _largest_rate(robot, state, "m/s")):
        raise BadRequest(name, _far(f"{away:.4g} m", f"{most:.3g} m"))
    if isinstance(measurement, Scan) and robot.heading is not None:
        turn = abs((measurement.pose[2] - state[robot.heading] + math.pi) % math.tau - math.pi)
        noise = measurement.heading_error + 2.0 * robot.measurement_bound[robot.heading]
        if turn > (most := noise + MAX_SCAN_AGE * _largest_rate(robot, state, "rad/s")):
            raise BadRequest(name, _far(f"{turn:.3g} rad", f"{most:.3g} rad"))


def _largest_rate(robot: Robot, state: Array, unit: str) -> float:
    """Return the largest rate in a unit that the inputs allow, or the measured one; infinite if no input has it."""
    inputs = [i for i, label in enumerate(robot.action) if split_label(label)[1] == unit]
    if not inputs:
        return math.inf
    allowed = np.maximum(np.abs(robot.low()), np.abs(robot.high()))[inputs]
    measured = [state[i] for i, label in enumerate(robot.state) if split_label(label)[1] == unit]
    return max(float(np.linalg.norm(allowed)), float(np.linalg.norm(measured)))


def _far(away: str, most: str) -> str:
    """Return why a measurement is refused, and what to do."""
    return (
        f"its pose is {away} from the state, but in {MAX_SCAN_AGE:g} s the robot can move by {most} at most: give both "
        "in one frame (m, rad), and call `memory.reset()` after you move the robot"
    )

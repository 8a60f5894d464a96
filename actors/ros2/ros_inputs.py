"""What a robot's nodes told lately, and whether that is enough to decide on."""

from __future__ import annotations

import math
import threading
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from brakeline.actors.ros2.laser_obstacles import BadScan, HitErrors, LaserBeams, obstacles, read
from brakeline.actors.ros2.odometry import OdometryHistory
from brakeline.actors.ros2.sensor_frames import PlanarPose, TransformTree, name_of, place_of
from brakeline.messaging.obstacle import Obstacle
from brakeline.messaging.rejected_messages import headline
from brakeline.messaging.robot import Robot
from brakeline.messaging.ros2.cdr_messages import LaserScan, Odometry, TFMessage, Twist, TwistStamped, seconds, yaw_of

Array = NDArray[np.float64]

LONGEST_FRAME = 100  # characters of a frame's name


class InputMissing(Exception):
    """Something that a decision needs is missing or stale: the message says what."""


@dataclass(frozen=True)
class AgeLimits:
    """How old [s] what the decision is made on may be; older is as good as missing."""

    odometry: float = 0.15
    scan: float = 0.6  # from its first beam: a turn of a slow lidar, and the next one's wait
    command: float = 0.5
    ahead: float = 0.05  # that a stamp may lie in the future: clocks differ


@dataclass(frozen=True)
class SensorSettings:
    """mount: of the lidar in the robot's frame; None: as the transforms say. odometry_frame, base_frame: of TF, where
    it stands for odometry; empty base_frame: it does not."""

    range_error: float = 0.02  # m, at most
    zero_is_free: bool = False
    mount: PlanarPose | None = None
    odometry_frame: str = "odom"
    base_frame: str = ""


@dataclass(frozen=True)
class RawCommand:
    """A raw command (speed [m/s], turn rate [rad/s]), and when it came by the robot's clock."""

    action: Array
    at: float
    number: int


class RosInputs:
    """The latest of each. The handlers are called by the node's threads, the rest by whoever decides."""

    def __init__(self, robot: Robot, sensing: SensorSettings, fresh: AgeLimits) -> None:
        self.robot, self.sensing, self.fresh = robot, sensing, fresh
        self.frame = sensing.odometry_frame  # in which the state is
        self._errors = HitErrors.of(robot, sensing.range_error)
        self._lock = threading.Lock()
        self._track, self._frames = OdometryHistory(fresh.odometry), TransformTree()
        self._base = sensing.base_frame
        self._scan: tuple[LaserBeams, str] | None = None
        self._bad_scan = ""
        self._command: RawCommand | None = None
        self._commands = 0

    # --- handlers -------------------------------------------------------------------------------------------------

    def hear_odometry(self, message: Odometry) -> None:
        pose, twist = message.pose.pose, message.twist.twist
        with self._lock:
            self.frame = headline(message.header.frame_id, LONGEST_FRAME) or self.frame
            self._base = headline(message.child_frame_id, LONGEST_FRAME) or self._base
            self._track.add(
                seconds(message.header.stamp),
                *(pose.position.x, pose.position.y, yaw_of(pose.orientation)),
                *(twist.linear.x, twist.angular.z),
            )

    def hear_transforms(self, message: TFMessage) -> None:
        """Those that move: the robot's own in the odometry's frame counts."""
        for stamped in message.transforms:
            if (name_of(stamped.header.frame_id), name_of(stamped.child_frame_id)) == (
                name_of(self.sensing.odometry_frame),
                name_of(self.sensing.base_frame),
            ):
                place = place_of(stamped.transform)
                if place is not None:
                    with self._lock:
                        self._track.add_pose(seconds(stamped.header.stamp), place.x, place.y, place.yaw)

    def hear_fixed_transforms(self, message: TFMessage) -> None:
        with self._lock:
            for stamped in message.transforms:
                self._frames.add(stamped)

    def hear_scan(self, message: LaserScan) -> None:
        try:
            frame = headline(message.header.frame_id, LONGEST_FRAME)
            scan, bad = (read(message, self.sensing.zero_is_free), frame), ""
        except BadScan as error:
            scan, bad = None, str(error)
        with self._lock:
            self._scan, self._bad_scan = scan or self._scan, bad

    def hear_command(self, message: Twist | TwistStamped, now: float) -> None:
        twist = message.twist if isinstance(message, TwistStamped) else message
        with self._lock:
            self._commands += 1
            self._command = RawCommand(np.array([twist.linear.x, twist.angular.z]), now, self._commands)

    # --- what there is to decide on -----------------------------------------------------------------------------------

    def forget(self) -> None:
        """The clock was set: nothing that came before counts."""
        with self._lock:
            self._track, self._scan, self._command = OdometryHistory(self.fresh.odometry), None, None

    def state(self, at: float, now: float) -> Array:
        """(5,) as measured at that time. Raises InputMissing."""
        with self._lock:
            newest, state = self._track.newest, self._track.state(at)
        if newest == -math.inf:
            raise InputMissing("no odometry yet")
        self._check("odometry", newest, now, self.fresh.odometry)
        if state is None:
            raise InputMissing("no odometry of when the period began")
        return state

    def obstacles(self, around: Array, now: float) -> tuple[Obstacle, ...]:
        """Those that the last scan speaks of near a position (2,), in the odometry's frame. Raises InputMissing."""
        with self._lock:
            if self._bad_scan:
                raise InputMissing(f"no scan that makes sense: {self._bad_scan}")
            if self._scan is None:
                raise InputMissing("no scan yet")
            beams, frame = self._scan
            self._check("the scan", float(beams.times[0]), now, self.fresh.scan)
            poses = self._track.at(beams.times)
            mount = self.sensing.mount or self._frames.place(frame, self._base or frame)
        if poses is None:
            raise InputMissing("no odometry of when the scan was made")
        if mount is None:
            raise InputMissing(f"no level transform from {self._base!r} to {frame!r}: give the lidar's place")
        return obstacles(beams, poses, mount, self.robot, self._errors, around)

    def command(self, now: float) -> RawCommand | None:
        """The last one; None: none lately."""
        with self._lock:
            command = self._command
        if command is None or now - command.at > self.fresh.command:
            return None
        return command

    def _check(self, what: str, stamp: float, now: float, limit: float) -> None:
        age = now - stamp
        if age > limit:
            raise InputMissing(
                f"{what} is {age:.2f} s old" if age < 1e3 else f"{what} is of another time: compare the clocks"
            )
        if age < -self.fresh.ahead:
            raise InputMissing(f"{what} is {-age:.2f} s in the future: compare the clocks")

"""The latest messages of a robot's nodes, and whether they are complete and fresh enough for a decision."""

from __future__ import annotations

import math
import threading
from dataclasses import dataclass

import numpy as np

from brakeline.actors.ros2.laser_beams import LaserBeams, read
from brakeline.actors.ros2.laser_obstacles import HitErrors, obstacles
from brakeline.actors.ros2.odometry import OdometryHistory, StepLimits
from brakeline.actors.ros2.ros2_settings import AgeLimits, SensorSettings
from brakeline.actors.ros2.sensor_frames import (
    FARTHEST_MOUNT,
    MOST_LEAN,
    MOST_TILT,
    PlanarPose,
    TransformTree,
    frame_name,
    pose_of,
    tilt_of,
)
from brakeline.actors.ros2.unknown_space import UnknownSpace
from brakeline.errors import BadScan, InputMissing, PoseJumped
from brakeline.messaging.obstacle import Obstacle
from brakeline.messaging.rejected_messages import headline
from brakeline.messaging.robot import Array, Robot
from brakeline.messaging.ros2.cdr_messages import LaserScan, Odometry, TFMessage, Twist, TwistStamped, seconds, yaw_of

LONGEST_FRAME = 100  # characters of a frame's name
OTHER_CLOCK = 1e3  # s: a message of this age has the time of another clock


@dataclass(frozen=True)
class RawCommand:
    """A raw command: speed [m/s] and turn rate [rad/s], the time [s] of its arrival by the robot's clock, a number."""

    action: Array
    at: float
    number: int


class RosInputs:
    """The latest input of each kind. The node's threads call the handlers `on_…`; one other thread calls the rest."""

    def __init__(self, robot: Robot, settings: SensorSettings, limits: AgeLimits) -> None:
        self.robot, self.settings, self.limits = robot, settings, limits
        self.frame = settings.odometry_frame  # of the state
        self._errors = HitErrors.of(robot, settings.range_error)
        self._unknown = UnknownSpace(robot, self._errors, settings.least_width, settings.free_at_start)
        self._lock = threading.Lock()
        self._odometry, self._transforms = self._no_odometry(), TransformTree()
        self._bad_odometry = ""
        self._base = settings.base_frame
        self._scan: tuple[LaserBeams, str] | None = None
        self._bad_scan = ""
        self._command: RawCommand | None = None
        self._commands = 0

    def on_odometry(self, message: Odometry) -> None:
        """Handle odometry; in another frame, or of a body that leans, it counts as missing until the next good one."""
        pose, twist = message.pose.pose, message.twist.twist
        frame = headline(message.header.frame_id, LONGEST_FRAME)
        if frame_name(frame) != frame_name(self.frame):
            with self._lock:
                self._bad_odometry = f"the odometry is in frame {frame!r}, not in {self.frame!r} (see --odometry-frame)"
            return
        with self._lock:
            if not self._accept_lean(tilt_of(pose.orientation)):
                return
            self._base = headline(message.child_frame_id, LONGEST_FRAME) or self._base
            self._odometry.add(
                seconds(message.header.stamp),
                *(pose.position.x, pose.position.y, yaw_of(pose.orientation)),
                *(twist.linear.x, twist.angular.z),
            )

    def on_transforms(self, message: TFMessage) -> None:
        """Handle moving transforms: that of the robot in the odometry's frame counts."""
        wanted = frame_name(self.settings.odometry_frame), frame_name(self.settings.base_frame)
        for stamped in message.transforms:
            frames = frame_name(stamped.header.frame_id), frame_name(stamped.child_frame_id)
            pose = pose_of(stamped.transform) if frames == wanted else None
            if pose is None:
                continue
            with self._lock:
                if self._accept_lean(pose.tilt):
                    self._odometry.add_pose(seconds(stamped.header.stamp), pose.x, pose.y, pose.yaw)

    def _accept_lean(self, tilt: float) -> bool:
        """Return whether the odometry of a body that leans by an angle [rad] counts; note why, if not."""
        leans, angle, most = tilt > MOST_LEAN, math.degrees(tilt), math.degrees(MOST_LEAN)  # NaN is dropped later
        why = f"the robot leans by {angle:.0f}° against {self.frame!r}: it may lean by at most {most:.0f}°"
        self._bad_odometry = why if leans else ""
        return not leans

    def on_fixed_transforms(self, message: TFMessage) -> None:
        with self._lock:
            for stamped in message.transforms:
                self._transforms.add(stamped)

    def on_scan(self, message: LaserScan) -> None:
        """Handle a scan; one that is not valid counts as missing until the next valid one."""
        try:
            frame = headline(message.header.frame_id, LONGEST_FRAME)
            scan, bad = (read(message, self.settings.zero_is_free), frame), ""
        except BadScan as error:
            scan, bad = None, str(error)
        with self._lock:
            self._scan, self._bad_scan = scan or self._scan, bad

    def on_command(self, message: Twist | TwistStamped, now: float) -> None:
        """Handle a raw command that arrives now [s]."""
        twist = message.twist if isinstance(message, TwistStamped) else message
        with self._lock:
            self._commands += 1
            self._command = RawCommand(np.array([twist.linear.x, twist.angular.z]), now, self._commands)

    def executed(self, action: Array, now: float) -> None:
        """Note that the robot executes an input (2,) from now [s] on."""
        with self._lock:
            self._odometry.executed(now, *action.tolist())

    def forget(self) -> None:
        """Drop everything with a time stamp, since the clock was set."""
        with self._lock:
            self._odometry, self._scan, self._command = self._no_odometry(), None, None
            self._unknown.reset()

    def state(self, at: float, now: float) -> Array:
        """Return the measured state (5,) at a time [s]. Raises InputMissing; PoseJumped: once for each jump."""
        with self._lock:
            self._check_jump()
            if self._bad_odometry:
                raise InputMissing(self._bad_odometry)
            newest, state = self._odometry.newest, self._odometry.state(at)
        if newest == -math.inf:
            raise InputMissing("no odometry yet")
        self._check_age("odometry", newest, now, self.limits.odometry)
        if state is None:
            raise InputMissing("no odometry of when the period began")
        return state

    def obstacles(self, around: Array, now: float) -> tuple[Obstacle, ...]:
        """Return the last scan's obstacles near a position (2,) [m], in the odometry's frame. Raises as `state`."""
        with self._lock:
            self._check_jump()
            if self._bad_scan:
                raise InputMissing(f"no valid scan: {self._bad_scan}")
            if self._scan is None:
                raise InputMissing("no scan yet")
            beams, frame = self._scan
            self._check_age("the scan", float(beams.times.min()), now, self.limits.scan)
            poses = self._odometry.at(beams.times)
            mount, base = self.settings.mount, self._base
            if mount is None and base:
                mount = self._transforms.pose(frame, base)
        if poses is None:
            raise InputMissing("no odometry of when the scan was made")
        if mount is None:
            why = f"no transform from {base!r} to {frame!r}" if base else "the odometry names no child frame"
            raise InputMissing(f"{why}: give the lidar's place")
        self._check_mount(mount, frame, base)
        try:
            unknown = self._unknown.boxes(beams, poses, mount, around)
        except BadScan as error:
            raise InputMissing(f"no valid scan: {error}") from error
        informed = beams.known | beams.too_near
        hits = obstacles(beams.take(informed), poses[informed], mount, self.robot, self._errors, around)
        return (*hits, *unknown)

    def command(self, now: float) -> RawCommand | None:
        """Return the last command; None if it is older than its age limit."""
        with self._lock:
            command = self._command
        if command is None or not now - command.at <= self.limits.command:  # a limit of NaN accepts nothing
            return None
        return command

    def _check_mount(self, mount: PlanarPose, frame: str, base: str) -> None:
        """Raise InputMissing if a lidar can't be where a transform or the settings place it on the robot."""
        if mount.tilt > MOST_TILT:
            raise InputMissing(
                f"{frame!r} is tilted by {math.degrees(mount.tilt):.1f}° against {base!r}: a lidar may be tilted by at "
                f"most {math.degrees(MOST_TILT):.0f}°"
            )
        if not (away := math.hypot(mount.x, mount.y)) <= FARTHEST_MOUNT * self.robot.footprint:
            raise InputMissing(
                f"the lidar is {away:.4g} m from the origin of {base!r}, but the body reaches "
                f"{self.robot.footprint:g} m: give the lidar's place in m"
            )

    def _no_odometry(self) -> OdometryHistory:
        return OdometryHistory(StepLimits.of(self.robot, self.limits.odometry), self.limits.odometry)

    def _check_jump(self) -> None:
        if why := self._odometry.jump:
            self._odometry.jump = ""
            self._unknown.reset()
            raise PoseJumped(why)

    def _check_age(self, what: str, stamp: float, now: float, limit: float) -> None:
        age = now - stamp
        if age > OTHER_CLOCK:
            raise InputMissing(f"{what} has the time of another clock: compare the clocks")
        if not age <= limit:
            raise InputMissing(f"{what} is {age:.2f} s old")
        if not age >= -self.limits.ahead:
            raise InputMissing(f"{what} is {-age:.2f} s in the future: compare the clocks")

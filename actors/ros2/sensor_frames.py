"""Poses of sensors on a robot, from the transforms that its nodes publish; all of them in the plane.

A scan counts as one in the plane, at the height of its sensor. With a tilt t, the end of a beam of length r is up to
r sin t above or below that plane, and its distance in the plane is shorter than r by up to r (1 - cos t). With
`MOST_TILT` (3°), these errors are 5 cm and 1.4 mm for each metre. The range stays within the error that a lidar has
anyway (2 cm, up to 14 m), and a lidar 0.2 m above the floor does not see the floor nearer than 3.8 m. With 18°, the
errors are 31 cm and 5 cm for each metre: the scan misses what stands in the plane, and shows what does not.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from brakeline.messaging.ros2.cdr_messages import Quaternion, Transform, TransformStamped, yaw_of

MOST_TILT = math.radians(3.0)  # of a lidar against the robot
MOST_LEAN = math.radians(18.0)  # of a robot against the frame of its odometry, as on a ramp
FARTHEST_MOUNT = 10.0  # radii of the body from the robot's position to its lidar: a place in mm is farther away
LONGEST_CHAIN = 32  # transforms from one frame to another


@dataclass(frozen=True)
class PlanarPose:
    """A pose in the plane: x, y [m], yaw [rad], and by how much it may be tilted out of the plane [rad]."""

    x: float = 0.0
    y: float = 0.0
    yaw: float = 0.0
    tilt: float = 0.0

    def compose(self, other: PlanarPose) -> PlanarPose:
        """Return `other`, a pose in this pose's frame, in the frame of this pose. Tilts add up, at most."""
        cos, sin = math.cos(self.yaw), math.sin(self.yaw)
        x, y = self.x + cos * other.x - sin * other.y, self.y + sin * other.x + cos * other.y
        return PlanarPose(x, y, self.yaw + other.yaw, self.tilt + other.tilt)

    def inverse(self) -> PlanarPose:
        """Return the inverse transform."""
        cos, sin = math.cos(self.yaw), math.sin(self.yaw)
        return PlanarPose(-cos * self.x - sin * self.y, sin * self.x - cos * self.y, -self.yaw, self.tilt)


def tilt_of(q: Quaternion) -> float:
    """Return the angle [rad] between the vertical axis and the one that a rotation turns it to."""
    return 2.0 * math.atan2(math.hypot(q.x, q.y), math.hypot(q.z, q.w))


def pose_of(transform: Transform) -> PlanarPose | None:
    """Return a transform as a pose in the plane; None: it has numbers that are not finite."""
    t, yaw, tilt = transform.translation, yaw_of(transform.rotation), tilt_of(transform.rotation)
    return PlanarPose(t.x, t.y, yaw, tilt) if all(map(math.isfinite, (yaw, tilt, t.x, t.y))) else None


class TransformTree:
    """The fixed transforms so far: the parent of each frame, and the frame's pose in its parent."""

    def __init__(self) -> None:
        self._parents: dict[str, tuple[str, PlanarPose | None]] = {}

    def add(self, stamped: TransformStamped) -> None:
        """Add a transform, or replace the one of the same frame."""
        parent, child = frame_name(stamped.header.frame_id), frame_name(stamped.child_frame_id)
        self._parents[child] = parent, pose_of(stamped.transform)

    def pose(self, frame: str, base: str) -> PlanarPose | None:
        """Return the pose of a frame in the frame `base`; None: it is unknown."""
        above_frame, above_base = self._ancestors(frame_name(frame)), self._ancestors(frame_name(base))
        for name, pose in above_frame.items():
            if pose is not None and (base_pose := above_base.get(name)) is not None:
                return base_pose.inverse().compose(pose)
        return None

    def _ancestors(self, frame: str) -> dict[str, PlanarPose | None]:
        """Return the frame and all frames above it, each with the pose of the frame in it."""
        pose: PlanarPose | None = PlanarPose()
        above = {frame: pose}
        for _ in range(LONGEST_CHAIN):
            if frame not in self._parents:
                break
            frame, step = self._parents[frame]
            pose = None if pose is None or step is None else step.compose(pose)
            above.setdefault(frame, pose)
        return above


def frame_name(frame: str) -> str:
    """Return a frame's name without the slash that older ROS versions write before it."""
    return frame.lstrip("/")

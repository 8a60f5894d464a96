"""Poses of sensors on a robot, from the transforms that its nodes publish; all of them in the plane."""

from __future__ import annotations

import math
from dataclasses import dataclass

from brakeline.messaging.ros2.cdr_messages import Transform, TransformStamped, yaw_of

MOST_TILT = 0.05  # 1 minus the vertical part of a transform's z axis
LONGEST_CHAIN = 32  # transforms from one frame to another


@dataclass(frozen=True)
class PlanarPose:
    """A pose in the plane: x, y [m], yaw [rad]."""

    x: float = 0.0
    y: float = 0.0
    yaw: float = 0.0

    def compose(self, other: PlanarPose) -> PlanarPose:
        """Return `other`, a pose in this pose's frame, in the frame of this pose."""
        cos, sin = math.cos(self.yaw), math.sin(self.yaw)
        return PlanarPose(
            self.x + cos * other.x - sin * other.y, self.y + sin * other.x + cos * other.y, self.yaw + other.yaw
        )

    def inverse(self) -> PlanarPose:
        """Return the inverse transform."""
        cos, sin = math.cos(self.yaw), math.sin(self.yaw)
        return PlanarPose(-cos * self.x - sin * self.y, sin * self.x - cos * self.y, -self.yaw)


def pose_of(transform: Transform) -> PlanarPose | None:
    """Return a transform as a pose in the plane; None: it tilts, is upside down, or has numbers that are not finite."""
    q, t = transform.rotation, transform.translation
    yaw = yaw_of(q)
    upright = 1.0 - 2.0 * (q.x * q.x + q.y * q.y)
    if not all(map(math.isfinite, (yaw, t.x, t.y))) or upright < 1.0 - MOST_TILT:
        return None
    return PlanarPose(t.x, t.y, yaw)


class TransformTree:
    """The fixed transforms so far: the parent of each frame, and the frame's pose in its parent."""

    def __init__(self) -> None:
        self._parents: dict[str, tuple[str, PlanarPose | None]] = {}

    def add(self, stamped: TransformStamped) -> None:
        """Add a transform, or replace the one of the same frame."""
        parent, child = frame_name(stamped.header.frame_id), frame_name(stamped.child_frame_id)
        self._parents[child] = parent, pose_of(stamped.transform)

    def pose(self, frame: str, base: str) -> PlanarPose | None:
        """Return the pose of a frame in the frame `base`; None: it is unknown or not level."""
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

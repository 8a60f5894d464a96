"""Where sensors sit on a robot, by the transforms that its nodes publish; all of it in the plane."""

from __future__ import annotations

import math
from dataclasses import dataclass

from brakeline.messaging.ros2.cdr_messages import Transform, TransformStamped, yaw_of

LEVEL = 0.05  # 1: how far from upright a transform's z axis may point
LONGEST = 32  # transforms from one frame to another


@dataclass(frozen=True)
class PlanarPose:
    """A pose in the plane: x, y [m], yaw [rad]."""

    x: float = 0.0
    y: float = 0.0
    yaw: float = 0.0

    def then(self, other: PlanarPose) -> PlanarPose:
        """A place given in this one's frame, in the frame of this one."""
        cos, sin = math.cos(self.yaw), math.sin(self.yaw)
        return PlanarPose(
            self.x + cos * other.x - sin * other.y, self.y + sin * other.x + cos * other.y, self.yaw + other.yaw
        )

    def inverse(self) -> PlanarPose:
        cos, sin = math.cos(self.yaw), math.sin(self.yaw)
        return PlanarPose(-cos * self.x - sin * self.y, sin * self.x - cos * self.y, -self.yaw)


def place_of(transform: Transform) -> PlanarPose | None:
    """A transform in the plane; None: it tilts, turns upside down, or holds no numbers."""
    q, t = transform.rotation, transform.translation
    yaw = yaw_of(q)
    upright = 1.0 - 2.0 * (q.x * q.x + q.y * q.y)
    if not all(map(math.isfinite, (yaw, t.x, t.y))) or upright < 1.0 - LEVEL:
        return None
    return PlanarPose(t.x, t.y, yaw)


class TransformTree:
    """The fixed transforms heard so far: each frame's parent, and its place there."""

    def __init__(self) -> None:
        self._parents: dict[str, tuple[str, PlanarPose | None]] = {}

    def add(self, stamped: TransformStamped) -> None:
        self._parents[name_of(stamped.child_frame_id)] = (
            name_of(stamped.header.frame_id),
            place_of(stamped.transform),
        )

    def place(self, frame: str, base: str) -> PlanarPose | None:
        """Of a frame in another; None: unknown, or it is not level."""
        up, down = self._to_root(name_of(frame)), self._to_root(name_of(base))
        for name, place in up.items():
            if name in down and place is not None and (other := down[name]) is not None:
                return other.inverse().then(place)
        return None

    def _to_root(self, frame: str) -> dict[str, PlanarPose | None]:
        """Every frame above this one, itself first, with this one's place there."""
        place: PlanarPose | None = PlanarPose()
        above = {frame: place}
        for _ in range(LONGEST):
            if frame not in self._parents:
                break
            frame, step = self._parents[frame]
            place = None if place is None or step is None else step.then(place)
            above.setdefault(frame, place)
        return above


def name_of(frame: str) -> str:
    """A frame's name: those of old have a slash before it."""
    return frame.lstrip("/")

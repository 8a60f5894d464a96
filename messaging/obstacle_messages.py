"""Obstacles in messages."""

from __future__ import annotations

from collections.abc import Iterable

from brakeline.errors import BadShape
from brakeline.messaging import brakeline_pb2 as pb
from brakeline.messaging.obstacle import Obstacle
from brakeline.messaging.obstacle_motion import Motion, Sighting


def obstacle_messages(obstacles: Iterable[Obstacle]) -> list[pb.Obstacle]:
    """Return a message for each obstacle."""
    return [
        pb.Obstacle(
            kind=o.kind, position=o.position, size=o.size, yaw=o.yaw, margin=o.margin, motion=_motion_message(o)
        )
        for o in obstacles
    ]


def _motion_message(obstacle: Obstacle) -> pb.Motion | None:
    if (motion := obstacle.motion) is None:
        return None
    message = pb.Motion(
        velocity=motion.velocity,
        position_error=motion.position_error,
        velocity_error=motion.velocity_error,
        acceleration=motion.acceleration,
        speed=motion.speed,
        age=motion.age,
    )
    if motion.before is not None:
        message.before_position.extend(motion.before.position)
        message.before_velocity.extend(motion.before.velocity)
        message.since = motion.before.since
    return message


def obstacle_of(message: pb.Obstacle, dim: int) -> Obstacle:
    """Return the obstacle in a message, for a world of 2 or 3 dimensions.

    Raises:
        BadShape: a value is wrong; `field` names it.
    """
    if not dim:
        raise BadShape("position", "a robot without a position has no obstacles, only limits")
    if len(message.position) != dim:
        raise BadShape("position", f"{len(message.position)} coordinates; this robot's obstacles have {dim}")
    motion = _motion_of(message.motion) if message.HasField("motion") else None
    return Obstacle(message.kind, tuple(message.position), tuple(message.size), message.yaw, message.margin, motion)


def _motion_of(message: pb.Motion) -> Motion:
    before = None
    if message.before_position or message.before_velocity:
        before = Sighting(tuple(message.before_position), tuple(message.before_velocity), message.since)
    return Motion(
        tuple(message.velocity),
        message.position_error,
        message.velocity_error,
        acceleration=message.acceleration if message.HasField("acceleration") else None,
        speed=message.speed if message.HasField("speed") else None,
        age=message.age,
        before=before,
    )

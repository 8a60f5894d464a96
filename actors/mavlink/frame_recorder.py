"""MAVLink frames on their way into the log: collected as they come, published once a period."""

from __future__ import annotations

import time
from collections import deque
from typing import TYPE_CHECKING, Protocol

from google.protobuf.message import Message

from brakeline.messaging import brakeline_pb2 as pb

if TYPE_CHECKING:
    from brakeline.actors.mavlink.frame_log import CapturedFrame


PART = 1000  # frames in a message, at most


class MessageSink(Protocol):
    """A publisher, or what stands before one."""

    def put(self, message: Message) -> None:
        """Publish it."""


class FrameRecorder:
    """Takes frames, in whatever thread, and publishes those of a period as one message."""

    def __init__(self, publisher: MessageSink, robot: str, actor: str) -> None:
        self.publisher, self._robot, self._actor = publisher, robot, actor
        self._frames: deque[pb.MavlinkFrame] = deque()

    def take(self, frame: CapturedFrame) -> None:
        """A frame that was sent or received now."""
        self.keep(pb.MavlinkFrame(wall_time=time.time_ns(), outgoing=frame.outgoing, raw=frame.raw))

    def keep(self, frame: pb.MavlinkFrame) -> None:
        """Take a frame that another process sent or received."""
        self._frames.append(frame)

    def publish(self) -> None:
        """Those since the last call, if there are any; in parts, for a message has a largest size."""
        while self._frames:
            frames = [self._frames.popleft() for _ in range(min(PART, len(self._frames)))]
            self.publisher.put(pb.MavlinkFrames(robot=self._robot, actor=self._actor, frames=frames))

"""Collect MAVLink frames as they come, and publish those of a period as one message."""

from __future__ import annotations

from collections import deque
from typing import TYPE_CHECKING, Protocol

from google.protobuf.message import Message

from brakeline.messaging import brakeline_pb2 as pb
from brakeline.messaging.steady_clock import steady_time_ns

if TYPE_CHECKING:
    from brakeline.actors.mavlink.frame_log import CapturedFrame


MOST_FRAMES = 1000  # in a message, whose size is limited


class MessageSink(Protocol):
    """A publisher, or something that passes messages on to one."""

    def put(self, message: Message) -> None:
        """Publish a message."""


def frame_message(frame: CapturedFrame) -> pb.MavlinkFrame:
    """Return the message of a frame that was sent or received just now."""
    return pb.MavlinkFrame(wall_time=steady_time_ns(), outgoing=frame.outgoing, raw=frame.raw)


class FrameRecorder:
    """Collects the frames of one vehicle from any thread."""

    def __init__(self, publisher: MessageSink, robot: str, actor: str) -> None:
        self.publisher, self._robot, self._actor = publisher, robot, actor
        self._frames: deque[pb.MavlinkFrame] = deque()

    def record(self, frame: CapturedFrame) -> None:
        """Collect a frame that was sent or received just now."""
        self.add(frame_message(frame))

    def add(self, frame: pb.MavlinkFrame) -> None:
        """Collect a frame that another process sent or received."""
        self._frames.append(frame)

    def publish(self) -> None:
        """Publish the frames since the last call, if there are any."""
        while self._frames:
            frames = [self._frames.popleft() for _ in range(min(MOST_FRAMES, len(self._frames)))]
            self.publisher.put(pb.MavlinkFrames(robot=self._robot, actor=self._actor, frames=frames))

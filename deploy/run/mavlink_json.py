"""Write MAVLink frames into the log as JSON, too, as other recorders do: channel `mavlink/SYSTEM/COMPONENT/MESSAGE`.

{"header": {"system_id": 1, "component_id": 1, "sequence": 7}, "message": {"type": "HEARTBEAT", …}}
"""

from __future__ import annotations

import json
import logging
from collections.abc import Callable, Iterable

from brakeline.actors.mavlink.frame_log import decode_frame
from brakeline.logs.segment import Entry
from brakeline.messaging.bus import Sample
from brakeline.messaging.topics import FRAMES

log = logging.getLogger("brakeline.frames")

ENCODING = "application/json;mavlink"
Derive = Callable[[Sample], Iterable[Entry]]


def frames_as_json(sample: Sample) -> list[Entry]:
    """Return a log entry for each frame of a FRAMES message, with the time of the frame. Other messages give none.

    Raises:
        Malformed: the message can't be decoded.
        ValueError: the time of a frame can't be stored.
    """
    if sample.topic is not FRAMES:
        return []
    entries = []
    for frame in sample.message().frames:
        message = decode_frame(frame.raw, frame.outgoing)
        if message is not None:
            text = json.dumps(message.described).encode()
            entries.append(Entry(message.name, ENCODING, text, sample.received, frame.wall_time, 0))
    return entries

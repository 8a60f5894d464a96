"""MAVLink frames in the log as JSON beside the bytes: `mavlink/SYSTEM/COMPONENT/MESSAGE`, as other recorders write it.

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


def as_json(sample: Sample) -> list[Entry]:
    """An entry for each frame of a FRAMES message, dated when it was sent or received; nothing for other messages.

    Raises:
        Malformed: it can't be understood; ValueError: a frame's time can't be stored.
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


def both(*derived: Derive) -> Derive:
    """What several make of a sample, one after the other."""
    return lambda sample: [entry for derive in derived for entry in derive(sample)]

"""The MAVLink frames of a log as a .tlog, which ground stations and pymavlink read.

Before each frame stands its time, µs since the Unix epoch, 8 bytes, the highest first.
"""

from __future__ import annotations

import struct
from typing import BinaryIO

from brakeline.logs.minari_export import ExportError
from brakeline.logs.reader import Paths, open_log

TIME = struct.Struct(">Q")


def to_tlog(paths: Paths, file: BinaryIO) -> int:
    """Write every frame of every vehicle in the log, in the order in which they came; returns how many.

    Raises:
        ExportError: it holds none; NoLog, NotALog: there is no log.
    """
    count = 0
    for record in open_log(paths):
        if record.topic == "frames":
            for frame in record.message.frames:
                file.write(TIME.pack(frame.wall_time // 1000) + frame.raw)
                count += 1
    if not count:
        raise ExportError("no MAVLink frame is in the log: training in memory logs them only with --mavlink")
    return count

"""Export the MAVLink frames of a log as a .tlog file for ground stations and pymavlink.

Each frame follows its time: µs since the Unix epoch, 8 bytes, big-endian.
"""

from __future__ import annotations

import struct
from typing import BinaryIO

from brakeline.errors import ExportError
from brakeline.logs.reader import Paths, open_log

TIME = struct.Struct(">Q")


def to_tlog(paths: Paths, file: BinaryIO) -> int:
    """Write all frames of all vehicles in the order of arrival, and return their number.

    Raises:
        ExportError: the log has no frame.
        LogError: as `open_log`.
    """
    count = 0
    for record in open_log(paths):
        if record.topic == "frames":
            for frame in record.message.frames:
                file.write(TIME.pack(frame.wall_time // 1000) + frame.raw)
                count += 1
    if not count:
        raise ExportError("the log has no MAVLink frame: `brakeline train` records frames only with --mavlink")
    return count

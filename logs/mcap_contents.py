"""Tell the log of a Brakeline run from a ROS bag by its content, also if the file is damaged."""

from __future__ import annotations

from pathlib import Path

from mcap.records import Header

from brakeline.errors import NotMcap
from brakeline.logs.mcap_container import LogChannel, records

ROS_PROFILES, ROS_ENCODINGS = ("ros1", "ros2"), ("ros1", "cdr")  # of files, of messages
OWN_SCHEMAS = "brakeline."  # how the names of Brakeline's message types begin


def is_ros(path: Path) -> bool:
    """Return True for an MCAP file of ROS messages: by its profile, or by the first message that decides."""
    with path.open("rb") as file:
        try:
            for item in records(file, path.stat().st_size, lambda key, schema: LogChannel(key, schema, None)):
                if isinstance(item, Header) and item.profile in ROS_PROFILES:
                    return True
                if type(item) is tuple:
                    channel = item[0].channel
                    if channel is not None and channel.message_encoding in ROS_ENCODINGS:
                        return True
                    if item[0].key.startswith(OWN_SCHEMAS):
                        return False
        except NotMcap:
            return False
    return False

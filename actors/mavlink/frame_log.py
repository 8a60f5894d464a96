"""MAVLink frames as they were sent or received, for logs and displays."""

from __future__ import annotations

import math
import struct
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from brakeline.actors.mavlink.ardupilot_dialect import mavlink


@dataclass(frozen=True)
class CapturedFrame:
    """One MAVLink frame. outgoing: sent to the autopilot; raw: its bytes; message: pymavlink's message."""

    outgoing: bool
    raw: bytes
    message: Any

    @property
    def name(self) -> str:
        """System, component and message, such as `mavlink/1/1/HEARTBEAT`."""
        m = self.message
        return f"mavlink/{m.get_srcSystem()}/{m.get_srcComponent()}/{m.get_type()}"

    @property
    def fields(self) -> dict[str, Any]:
        """The fields for JSON, which has no infinity and no NaN: they become None."""
        return {key: _json_value(value) for key, value in self.message.to_dict().items()}

    @property
    def described(self) -> dict[str, Any]:
        """Header and fields for JSON."""
        m, fields = self.message, self.fields
        header = {"system_id": m.get_srcSystem(), "component_id": m.get_srcComponent(), "sequence": m.get_seq()}
        return {"header": header, "message": {"type": fields.pop("mavpackettype"), **fields}}


FrameTap = Callable[[CapturedFrame], None]


def decode_frame(raw: bytes, outgoing: bool) -> CapturedFrame | None:
    """Return the frame of some bytes; None if they are not a frame."""
    try:
        message = mavlink.MAVLink(None).decode(bytearray(raw))
    except (mavlink.MAVError, IndexError, ValueError, struct.error):  # the last three of bytes that end too early
        return None
    return CapturedFrame(outgoing, raw, message)


def _json_value(value: Any) -> Any:
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, bytes | bytearray):
        return value.hex()
    if isinstance(value, list | tuple):
        return [_json_value(item) for item in value]
    return value

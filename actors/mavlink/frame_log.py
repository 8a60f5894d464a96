"""MAVLink frames as they were sent or received, for who records or shows them."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from brakeline.actors.mavlink.ardupilot_dialect import mavlink


@dataclass(frozen=True)
class CapturedFrame:
    """One MAVLink frame as it was sent or received."""

    outgoing: bool
    raw: bytes
    message: Any

    @property
    def name(self) -> str:
        """Such as `mavlink/1/1/HEARTBEAT`: system, component, message."""
        m = self.message
        return f"mavlink/{m.get_srcSystem()}/{m.get_srcComponent()}/{m.get_type()}"

    @property
    def fields(self) -> dict[str, Any]:
        """For JSON: numbers that are not finite become None."""
        return {key: _plain(value) for key, value in self.message.to_dict().items()}

    @property
    def described(self) -> dict[str, Any]:
        """Header and fields, for JSON."""
        m, fields = self.message, self.fields
        header = {"system_id": m.get_srcSystem(), "component_id": m.get_srcComponent(), "sequence": m.get_seq()}
        return {"header": header, "message": {"type": fields.pop("mavpackettype"), **fields}}


FrameTap = Callable[[CapturedFrame], None]


def decode_frame(raw: bytes, outgoing: bool) -> CapturedFrame | None:
    """A frame from its bytes; None if they are none."""
    try:
        message = mavlink.MAVLink(None).decode(bytearray(raw))
    except mavlink.MAVError:
        return None
    return CapturedFrame(outgoing, raw, message)


def _plain(value: Any) -> Any:
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, bytes | bytearray):
        return value.hex()
    if isinstance(value, list | tuple):
        return [_plain(inner) for inner in value]
    return value

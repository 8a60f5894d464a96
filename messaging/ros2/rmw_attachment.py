"""What rmw_zenoh sends along with each message: its number, when it was sent, and by whom."""

from __future__ import annotations

import struct
from dataclasses import dataclass

import xxhash

from brakeline.messaging.bus.bus_errors import Malformed

LAYOUT = struct.Struct("<qqB16s")
GID = 16  # bytes


def gid_of(token: str) -> bytes:
    """A publisher's global id, from its liveliness token: XXH3-128, the low half first, each little-endian."""
    return xxhash.xxh3_128_digest(token.encode())[::-1]


@dataclass(frozen=True)
class Attachment:
    sequence: int  # from 1, of each publisher
    time: int  # ns since the Unix epoch
    gid: bytes

    def encode(self) -> bytes:
        return LAYOUT.pack(self.sequence, self.time, GID, self.gid)

    @staticmethod
    def decode(payload: bytes) -> Attachment:
        """Raises Malformed."""
        try:
            sequence, time, length, gid = LAYOUT.unpack(payload)
        except struct.error as error:
            raise Malformed(f"no attachment: {error}") from error
        if length != GID:
            raise Malformed(f"no attachment: a global id of {length} bytes")
        return Attachment(sequence, time, gid)

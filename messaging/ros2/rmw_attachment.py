"""The attachment that rmw_zenoh sends with each message: sequence number, time and sender."""

from __future__ import annotations

import struct
from dataclasses import dataclass

import xxhash

from brakeline.errors import Malformed

LAYOUT = struct.Struct("<qqB16s")
GID = 16  # bytes


def gid_of(token: str) -> bytes:
    """Return a publisher's global id: XXH3-128 of its liveliness token, low half first, each half little-endian."""
    return xxhash.xxh3_128_digest(token.encode())[::-1]


@dataclass(frozen=True)
class Attachment:
    """The attachment of a message.

    Attributes:
        sequence: number of the message, from 1 on for each publisher.
        time: ns since the Unix epoch.
        gid: the publisher's global id.
    """

    sequence: int
    time: int
    gid: bytes

    def encode(self) -> bytes:
        """Encode the attachment."""
        return LAYOUT.pack(self.sequence, self.time, GID, self.gid)

    @staticmethod
    def decode(payload: bytes) -> Attachment:
        """Decode an attachment. Raises Malformed."""
        try:
            sequence, time, length, gid = LAYOUT.unpack(payload)
        except struct.error as error:
            raise Malformed(f"not an attachment: {error}") from error
        if length != GID:
            raise Malformed(f"not an attachment: a global id of {length} bytes")
        return Attachment(sequence, time, gid)

"""MCAP's container, front to back: what a file holds, also when it was cut off or bytes of it were changed.

Messages come as plain tuples, taken out of their chunks without an object each: several times as fast as the `mcap`
package's own non-seeking reader, whose classes read all other kinds of records here. A chunk whose checksum is wrong is
skipped, and said.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from io import BytesIO
from typing import IO, Any

import lz4.frame
import zstandard
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Attachment, Channel, Chunk, Metadata, Schema

MAGIC = b"\x89MCAP0\r\n"
LARGEST = 2**27  # bytes of a chunk's content: more is damage, not data
BROKEN = (McapError, struct.error, ValueError, EOFError, RuntimeError, zstandard.ZstdError)

SCHEMA, CHANNEL, MESSAGE = int(Opcode.SCHEMA), int(Opcode.CHANNEL), int(Opcode.MESSAGE)

_HEAD = struct.Struct("<BQ")  # opcode, length
_MESSAGE = struct.Struct("<HIQQ")  # channel, sequence, log_time, publish_time; then the payload
_TO_PAYLOAD = _HEAD.size + _MESSAGE.size


class NotMcap(Exception):
    """The file does not begin as an MCAP file does."""


@dataclass(frozen=True)
class DamagedBytes:
    """Bytes that cannot be read."""

    at: int  # where they begin
    lost: int  # how many there are; 0: the file only lacks its summary
    reason: str
    at_end: bool  # nothing can be read after them

    def __str__(self) -> str:
        if not self.lost:
            return f"it ended without a summary ({self.reason})"
        where = "its end" if self.at_end else f"byte {self.at}"
        return f"{self.lost} bytes at {where} could not be read ({self.reason})"


@dataclass(slots=True, eq=False)
class LogChannel:
    """A channel: the messages published at one key."""

    topic: str
    key: str
    decode: Callable[[bytes], Any] | None  # None: a type that we do not know
    schema: Schema | None = None
    channel: Channel | None = None
    known: bool = False
    place: str = ""  # the key without the topic: "ground/actor-0"
    sequence: int = 0  # of the message that was read last

    def __post_init__(self) -> None:
        self.known = self.decode is not None
        self.place = self.key.partition("/")[2]


Row = tuple[Any, int, int, bytes]  # Series, log_time, publish_time [ns], payload
Item = Row | Metadata | Attachment | DamagedBytes


class _Tables:
    """The schemas and channels that were read so far."""

    def __init__(self, make: Callable[[str, str], LogChannel]) -> None:
        self.make, self.schemas, self.series = make, dict[int, Schema](), dict[int, LogChannel]()

    def learn(self, opcode: int, content: bytes) -> None:
        stream = ReadDataStream(BytesIO(content))
        if opcode == SCHEMA:
            schema = Schema.read(stream)
            self.schemas[schema.id] = schema
        else:
            channel = Channel.read(stream)
            known = self.schemas.get(channel.schema_id)
            if channel.id not in self.series:  # it is repeated in the summary
                series = self.make(channel.topic, known.name if known is not None else "")
                series.schema, series.channel = known, channel
                self.series[channel.id] = series


def records(file: IO[bytes], size: int, make: Callable[[str, str], LogChannel]) -> Iterator[Item]:
    """Messages, metadata and attachments of a file of `size` bytes, and what of it is damaged, in order.

    `make` gives the series for a channel's topic and the name of its schema.

    Raises:
        NotMcap: it begins with something else; an empty file is only damaged.
    """
    tables = _Tables(make)
    magic = file.read(len(MAGIC))
    if not MAGIC.startswith(magic):
        raise NotMcap(f"it begins with {magic!r}")
    good = len(magic)  # bytes up to the end of the last whole record
    while True:
        head = file.read(_HEAD.size)
        opcode, length = _HEAD.unpack(head) if len(head) == _HEAD.size else (0, 0)
        end = good + _HEAD.size + length
        if not opcode or end > size:
            reason = "a record is cut off" if good < size else "the recorder was killed, or is still at work"
            yield DamagedBytes(good, size - good, reason, at_end=True)
            return
        content = file.read(length)
        try:
            if opcode == Opcode.CHUNK:
                yield from _unpacked(_uncompressed(content), tables)
            elif opcode == Opcode.FOOTER:
                if file.read(len(MAGIC)) != MAGIC:
                    yield DamagedBytes(end, size - end, "its last bytes are cut off", at_end=True)
                return
            else:
                yield from _plain(opcode, content, tables)
        except BROKEN as error:
            yield DamagedBytes(good, end - good, str(error) or type(error).__name__, at_end=False)
        good = end


def _plain(opcode: int, content: bytes, tables: _Tables) -> Iterator[Item]:
    """A record outside a chunk; those that only help to seek give nothing."""
    if opcode in (SCHEMA, CHANNEL):
        tables.learn(opcode, content)
    elif opcode == MESSAGE:
        yield from _unpacked(_HEAD.pack(opcode, len(content)) + content, tables)
    elif opcode == Opcode.METADATA:
        yield Metadata.read(ReadDataStream(BytesIO(content)))
    elif opcode == Opcode.ATTACHMENT:
        yield Attachment.read(ReadDataStream(BytesIO(content)))


def _uncompressed(content: bytes) -> bytes:
    """The records in a chunk, in memory for as many bytes as it says that it holds, whatever is packed in it.

    Raises one of `BROKEN`.
    """
    chunk = Chunk.read(ReadDataStream(BytesIO(content)))
    size = chunk.uncompressed_size
    if size > LARGEST:
        raise ValueError(f"a chunk says that it holds {size} bytes")
    if chunk.compression == "zstd":
        packed = zstandard.frame_content_size(chunk.data)  # -1: it does not say
        if packed not in (-1, size):  # `decompress` would believe it
            raise ValueError(f"a chunk says that it holds {size} bytes, and what is in it that it is {packed}")
        data = zstandard.decompress(chunk.data, size)
    elif chunk.compression == "lz4":
        data = lz4.frame.LZ4FrameDecompressor().decompress(chunk.data, size + 1)
    elif chunk.compression == "":
        data = chunk.data
    else:
        raise ValueError(f"a chunk is compressed by {chunk.compression!r}, which we do not know")
    if len(data) != size:
        raise ValueError(f"a chunk says that it holds {size} bytes, and holds {len(data)} or more")
    if chunk.uncompressed_crc and zlib.crc32(data) != chunk.uncompressed_crc:
        raise ValueError("the checksum of a chunk is wrong")
    return data


def _unpacked(data: bytes, tables: _Tables) -> Iterator[Row]:
    """The messages among the records in `data`. Raises one of `BROKEN`."""
    series, head, message = tables.series, _HEAD.unpack_from, _MESSAGE.unpack_from
    at, end = 0, len(data)
    while at < end:
        opcode, length = head(data, at)
        after = at + 9 + length
        if after > end:
            raise ValueError("a record is longer than its chunk")
        if opcode == MESSAGE:
            number, sequence, log_time, publish_time = message(data, at + 9)
            channel = series.get(number)
            if channel is None:
                raise ValueError(f"a message is of channel {number}, which is not declared")
            channel.sequence = sequence
            yield channel, log_time, publish_time, data[at + _TO_PAYLOAD : after]
        elif opcode in (SCHEMA, CHANNEL):
            tables.learn(opcode, data[at + 9 : after])
        at = after


def model_attachment_name(robot: str, version: str) -> str:
    """The name in a log of a model set."""
    return f"model/{robot}/{version}.safetensors"

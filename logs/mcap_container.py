"""Read an MCAP file from front to back, also when its end is missing or bytes of it were changed.

Why not `mcap.stream_reader.StreamReader`: it stops at the first damaged record, it decompresses as much as a chunk
contains (not as much as the chunk declares), and it creates an object for each message, which is several times slower.
The `mcap` package's record classes read everything but messages here. A chunk with a wrong checksum is skipped and
reported.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from io import BytesIO
from pathlib import Path
from typing import IO, Any

import lz4.frame
import zstandard
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Attachment, Channel, Chunk, Header, Metadata, Schema
from mcap.well_known import MessageEncoding

from brakeline.errors import NotMcap

MAGIC = b"\x89MCAP0\r\n"
MOST_CHUNK_BYTES = 2**27  # a chunk that declares more is damaged
BROKEN = (McapError, struct.error, ValueError, EOFError, OverflowError, RuntimeError, zstandard.ZstdError)

SCHEMA, CHANNEL, MESSAGE = int(Opcode.SCHEMA), int(Opcode.CHANNEL), int(Opcode.MESSAGE)
ROS_PROFILES, ROS_ENCODINGS = ("ros1", "ros2"), ("ros1", "cdr")  # of files, of messages
OWN_SCHEMAS = "brakeline."  # how the names of Brakeline's message types begin
# Metadata of a log: the topics of its own channels by their numbers. A chunk declares the channels that begin in it, so
# the later messages of a file without a summary would be lost with that chunk.
CHANNELS = "channels"

_HEAD = struct.Struct("<BQ")  # opcode, length
_MESSAGE = struct.Struct("<HIQQ")  # channel, sequence, log_time, publish_time; then the payload
_CHUNK = struct.Struct("<QQQII")  # first and last time, uncompressed size, checksum, length of the compression's name
_TO_PAYLOAD = _HEAD.size + _MESSAGE.size


@dataclass(frozen=True)
class DamagedBytes:
    """A range of bytes that cannot be read: the recorder was killed, the disk was full, or bytes were changed."""

    at: int  # offset of the first byte
    lost: int  # number of bytes; 0: only the summary is missing
    reason: str
    at_end: bool  # the range extends to the end of the file
    path: Path | None = None  # of the file, in a log

    def __str__(self) -> str:
        file = "" if self.path is None else f"{self.path}: "
        if not self.lost:
            return f"{file}the file has no summary ({self.reason})"
        where = "its end" if self.at_end else f"byte {self.at}"
        return f"{file}{self.lost} bytes at {where} cannot be read ({self.reason})"


@dataclass(frozen=True)
class ChangedBytes(DamagedBytes):
    """A part of a finished file in which bytes outside the chunks were changed, such as metadata or an index."""

    def __str__(self) -> str:
        file = "" if self.path is None else f"{self.path}: "
        return f"{file}bytes were changed between {self.at} and {self.at + self.lost} ({self.reason})"


class Checksum:
    """The running checksums of a file: of its data, then of its summary."""

    def __init__(self, magic: bytes) -> None:
        self._begin, self._crc = 0, zlib.crc32(magic)
        self.damaged = False  # the reader has reported damage of this part already

    def check(self, opcode: int, head: bytes, content: bytes, at: int) -> ChangedBytes | None:
        """Take in a record that begins at a byte. Returns the damage of the part that it ends."""
        stated, damage = 0, None
        if opcode == Opcode.DATA_END:
            stated, part = int.from_bytes(content[:4], "little"), "data"
        elif opcode == Opcode.FOOTER:
            stated, part = int.from_bytes(content[16:20], "little"), "summary"
            self._crc = zlib.crc32(head + content[:16], self._crc)
        else:
            self._crc = zlib.crc32(content, zlib.crc32(head, self._crc))
        if stated and stated != self._crc and not self.damaged:
            damage = ChangedBytes(self._begin, at - self._begin, f"the checksum of its {part} is wrong", at_end=False)
        if opcode == Opcode.DATA_END:
            self._begin, self._crc, self.damaged = at + len(head) + len(content), 0, False
        return damage


@dataclass(slots=True, eq=False)
class LogChannel:
    """A channel of the file: the messages published at one key.

    Attributes:
        topic: the topic of the channel in the file.
        key: the key of the bus at which the messages were published.
        decode: decodes a message; None for an unknown message type.
        schema, channel: the records of the file that declare the channel.
        robot, actor: the second and third part of the key, e.g. "ground" and "actor-0".
        names: the names that the key of a Brakeline topic contains, by field.
        sequence: the sequence number of the message that was read last.
    """

    topic: str
    key: str
    decode: Callable[[bytes], Any] | None
    schema: Schema | None = None
    channel: Channel | None = None
    robot: str = ""
    actor: str = ""
    names: dict[str, str] = field(default_factory=dict)
    sequence: int = 0

    def __post_init__(self) -> None:
        _, self.robot, self.actor = (*self.key.split("/", 2), "", "")[:3]


MakeChannel = Callable[[str, str | None], LogChannel]  # from the topic and the name of the schema; None: it is lost
Row = tuple[Any, int, int, bytes]  # LogChannel, log_time [ns], publish_time [ns], payload
Item = Row | Header | Metadata | Attachment | DamagedBytes


class Undeclared(ValueError):
    """Messages of a chunk on channels that no readable record declares.

    Attributes:
        size: of these messages, bytes.
    """

    def __init__(self, channels: Iterable[int], size: int) -> None:
        numbers = sorted(set(channels))
        name = "channel" if len(numbers) == 1 else "channels"
        super().__init__(f"messages are on the undeclared {name} {', '.join(map(str, numbers))}")
        self.size = size


class _Tables:
    """The schemas and channels that have been read.

    Attributes:
        summary: reads the records of the summary. They declare the channels of a damaged chunk once more.
    """

    def __init__(self, make: MakeChannel, summary: Callable[[], bytes]) -> None:
        self.make, self.schemas, self.channels = make, dict[int, Schema](), dict[int, LogChannel]()
        self.summary: Callable[[], bytes] | None = summary
        self.topics = dict[int, str]()  # as the metadata say, by the channel's number
        self.chunked = False  # the file has chunks

    def channel(self, number: int) -> LogChannel | None:
        """Return the channel of a message; None if nothing declares it."""
        if number not in self.channels:
            self._read_summary()
        if number not in self.channels and number in self.topics:
            channel = self.make(self.topics[number], None)
            channel.channel = Channel(number, self.topics[number], MessageEncoding.Protobuf, {}, 0)
            self.channels[number] = channel
        return self.channels.get(number)

    def note(self, topics: Mapping[str, str]) -> None:
        """Take in the metadata `CHANNELS`."""
        self.topics |= {int(number): topic for number, topic in topics.items() if number.isdecimal()}

    def _read_summary(self) -> None:
        if self.summary is not None:
            read, self.summary = self.summary, None
            list(_unpacked(read(), self))

    def add(self, opcode: int, content: bytes) -> None:
        stream = ReadDataStream(BytesIO(content))
        if opcode == SCHEMA:
            new = Schema.read(stream)
            self.schemas[new.id] = new
        else:
            record = Channel.read(stream)
            if record.id not in self.channels:  # the summary repeats it
                if record.schema_id and record.schema_id not in self.schemas:
                    self._read_summary()
                schema = self.schemas.get(record.schema_id)
                lost = None if record.message_encoding == MessageEncoding.Protobuf else ""
                channel = self.make(record.topic, lost if schema is None else schema.name)
                channel.schema, channel.channel = schema, record
                self.channels[record.id] = channel


def raw_channel(key: str, schema: str | None) -> LogChannel:
    """Return a channel whose messages are not decoded."""
    return LogChannel(key, key, None)


def records(file: IO[bytes], size: int, make: MakeChannel = raw_channel) -> Iterator[Item]:
    """Yield the header, messages, metadata, attachments and damage of a file, in order.

    Args:
        size: of the file, bytes.
        make: creates the channel.

    Raises:
        NotMcap: the file starts with other bytes. An empty file is only damaged.
    """
    tables = _Tables(make, lambda: _summary_again(file, size))
    magic = file.read(len(MAGIC))
    if not MAGIC.startswith(magic):
        raise NotMcap(f"the file starts with {magic!r}")
    read_to = len(magic)  # offset of the end of the last complete record
    checksum = Checksum(magic)
    while True:
        head = file.read(_HEAD.size)
        opcode, length = _HEAD.unpack(head) if len(head) == _HEAD.size else (0, 0)
        end = read_to + _HEAD.size + length
        if not opcode or end > size:
            reason = "a record is incomplete" if read_to < size else "the recorder was killed or is still running"
            if opcode == Opcode.CHUNK:
                count = 0
                for row in _messages_of_incomplete_chunk(file.read(), tables):
                    yield row
                    count += 1
                reason = f"a chunk is incomplete, of which {count} messages were read"
            yield DamagedBytes(read_to, size - read_to, reason, at_end=True)
            return
        content = file.read(length)
        if (changed := checksum.check(opcode, head, content, read_to)) is not None:
            yield changed
        try:
            if opcode == Opcode.CHUNK:
                tables.chunked = True
                yield from _unpacked(_uncompressed(content), tables)
            elif opcode == Opcode.FOOTER:
                if file.read(len(MAGIC)) != MAGIC:
                    yield DamagedBytes(end, size - end, "the last bytes are missing", at_end=True)
                return
            else:
                yield from _read_outside_chunk(opcode, content, tables)
        except BROKEN as error:
            checksum.damaged = True
            lost = min(error.size, end - read_to) if isinstance(error, Undeclared) else end - read_to
            yield DamagedBytes(read_to, lost, str(error) or type(error).__name__, at_end=False)
        read_to = end


def has_whole_summary(file: IO[bytes], size: int) -> bool:
    """Return whether the summary of a file is there, and has the right checksum if the file states one."""
    return _summary(file, size) is not None


def _summary(file: IO[bytes], size: int, stated: bool = False) -> bytes | None:
    """Return the records of a file's summary; None if it is missing, damaged, or `stated` and without a checksum."""
    footer = _HEAD.size + 20
    file.seek(max(0, size - len(MAGIC) - footer))
    last = file.read()
    if len(last) < footer + len(MAGIC) or not last.endswith(MAGIC) or last[0] != Opcode.FOOTER:
        return None
    start, crc = (int.from_bytes(last[at : at + n], "little") for at, n in ((_HEAD.size, 8), (_HEAD.size + 16, 4)))
    end = size - len(MAGIC) - footer
    if not 0 < start <= end:
        return None
    file.seek(start)
    data = file.read(end - start)
    whole = zlib.crc32(data + last[: footer - 4]) == crc if crc else not stated
    return data if whole else None


def _summary_again(file: IO[bytes], size: int) -> bytes:
    """Return the records of a whole summary with a checksum, or nothing. The position in the file stays."""
    at = file.tell()
    data = _summary(file, size, stated=True)
    file.seek(at)
    return data or b""


def _read_outside_chunk(opcode: int, content: bytes, tables: _Tables) -> Iterator[Item]:
    """Read a record outside a chunk. Index records yield nothing."""
    if opcode in (SCHEMA, CHANNEL):
        tables.add(opcode, content)
    elif opcode == MESSAGE:
        if tables.chunked and len(content) == _MESSAGE.size:  # one changed bit makes it of the index of a chunk
            raise ValueError("a message without content between chunks")
        yield from _unpacked(_HEAD.pack(opcode, len(content)) + content, tables)
    elif opcode == Opcode.HEADER:
        yield Header.read(ReadDataStream(BytesIO(content)))
    elif opcode == Opcode.METADATA:
        metadata = Metadata.read(ReadDataStream(BytesIO(content)))
        if metadata.name == CHANNELS:
            tables.note(metadata.metadata)
        else:
            yield metadata
    elif opcode == Opcode.ATTACHMENT:
        yield Attachment.read(ReadDataStream(BytesIO(content)))


def _uncompressed(content: bytes) -> bytes:
    """Return the uncompressed records of a chunk. Memory is limited to the size that the chunk declares.

    Raises one of `BROKEN`.
    """
    chunk = Chunk.read(ReadDataStream(BytesIO(content)))
    size = chunk.uncompressed_size
    if size > MOST_CHUNK_BYTES:
        raise ValueError(f"a chunk declares {size} bytes, more than {MOST_CHUNK_BYTES}")
    if chunk.compression == "zstd":
        declared = zstandard.frame_content_size(chunk.data)  # -1: the frame does not declare it
        if declared not in (-1, size):  # `decompress` would allocate this size
            raise ValueError(f"a chunk declares {size} bytes, and its zstd frame {declared}")
        data = zstandard.decompress(chunk.data, size)
    elif chunk.compression == "lz4":
        data = lz4.frame.LZ4FrameDecompressor().decompress(chunk.data, size + 1)
    elif chunk.compression == "":
        data = chunk.data
    else:
        raise ValueError(f"a chunk has the unknown compression {chunk.compression!r}")
    if len(data) != size:
        raise ValueError(f"a chunk declares {size} bytes and contains {len(data)} or more")
    if chunk.uncompressed_crc and zlib.crc32(data) != chunk.uncompressed_crc:
        raise ValueError("the checksum of a chunk is wrong")
    return data


def _messages_of_incomplete_chunk(content: bytes, tables: _Tables) -> Iterator[Row]:
    """Yield the messages at the beginning of an incomplete chunk."""
    try:
        _, _, size, _, length = _CHUNK.unpack_from(content)
        size, compression = min(size, MOST_CHUNK_BYTES), content[_CHUNK.size : _CHUNK.size + length]
        data = content[_CHUNK.size + length + 8 :]  # behind their length
        if compression == b"zstd":
            data = zstandard.ZstdDecompressor().stream_reader(data).read(size)
        elif compression == b"lz4":
            data = lz4.frame.LZ4FrameDecompressor().decompress(data, size)
        yield from _unpacked(data[:size], tables)
    except BROKEN:
        return


def _unpacked(data: bytes, tables: _Tables) -> Iterator[Row]:
    """Yield the messages among the records in `data`. Raises one of `BROKEN`: `Undeclared` after all other messages."""
    channels, head, message = tables.channels, _HEAD.unpack_from, _MESSAGE.unpack_from
    at, end = 0, len(data)
    undeclared: list[tuple[int, int]] = []  # channel and size
    while at < end:
        opcode, length = head(data, at)
        after = at + 9 + length
        if after > end:
            raise ValueError("a record is longer than its chunk")
        if opcode == MESSAGE:
            number, sequence, log_time, publish_time = message(data, at + 9)
            channel = channels.get(number) or tables.channel(number)
            if channel is None:
                undeclared.append((number, after - at))
            else:
                channel.sequence = sequence
                yield channel, log_time, publish_time, data[at + _TO_PAYLOAD : after]
        elif opcode in (SCHEMA, CHANNEL):
            tables.add(opcode, data[at + 9 : after])
        at = after
    if undeclared:
        raise Undeclared((number for number, _ in undeclared), sum(size for _, size in undeclared))


def is_ros(path: Path) -> bool:
    """Return True for an MCAP file of ROS messages: by its profile, or by the first message that decides."""
    with path.open("rb") as file:
        try:
            for item in records(file, path.stat().st_size):
                if isinstance(item, Header) and item.profile in ROS_PROFILES:
                    return True
                if type(item) is tuple:
                    channel, schema = item[0].channel, item[0].schema
                    if channel is not None and channel.message_encoding in ROS_ENCODINGS:
                        return True
                    if schema is not None and schema.name.startswith(OWN_SCHEMAS):
                        return False
        except NotMcap:
            return False
    return False


def model_attachment_name(robot: str, version: str) -> str:
    """Return the name of a model set's attachment in a log."""
    return f"model/{robot}/{version}.safetensors"

"""Read the messages of a bag file in the order of storage: ROS 1 (.bag), SQLite (.db3) and MCAP, also damaged ones.

`rosbags` opens only complete bags with an index. These readers need no index, no summary and no `metadata.yaml`: they
yield each message up to the damage, or around it.
"""

from __future__ import annotations

import bz2
import sqlite3
import struct
from collections.abc import Callable, Collection, Iterator
from contextlib import closing
from dataclasses import dataclass, field
from io import BytesIO
from pathlib import Path
from tempfile import NamedTemporaryFile
from typing import IO
from urllib.parse import quote

import lz4.frame
import zstandard

from brakeline.errors import NoSource
from brakeline.logs.mcap_container import MAGIC as MCAP_MAGIC
from brakeline.logs.mcap_container import DamagedBytes, LogChannel, records

ZSTD = b"\x28\xb5\x2f\xfd"  # the first bytes of a compressed message; CDR begins with 0
MOST_BYTES = 2**27  # of a record, after decompression: more is damaged
ROS1 = "ros1"  # the encoding of ROS 1's messages; that of ROS 2 is "cdr"
ROS1_MAGIC = b"#ROSBAG V2.0\n"
TIME = struct.Struct("<II")  # s, ns
BROKEN = (EOFError, KeyError, OSError, OverflowError, RuntimeError, ValueError, struct.error)


@dataclass(frozen=True)
class BagTopic:
    """A topic of a bag. `definition` is the text of the message type, or empty; `idl` says in which language."""

    name: str
    type: str
    encoding: str
    definition: str = ""
    idl: bool = False


@dataclass
class BagContents:
    """What a reader finds besides messages: topics in any order, and damage in sentences."""

    topics: set[BagTopic] = field(default_factory=set)
    damage: list[str] = field(default_factory=list)


Stored = tuple[BagTopic, int, bytes]  # topic, receive time in ns, message


def stored_messages(path: Path, types: Collection[str], contents: BagContents) -> Iterator[Stored]:
    """Yield the messages of the given types, and fill in `contents`. Raises NoSource if the file is not a bag."""
    with path.open("rb") as file:
        start = file.read(16)
    storage = next((storage for magic, storage in STORAGES.items() if start.startswith(magic)), None)
    if storage is None:
        raise NoSource(
            f"{path} is not a bag: it starts with {start!r}. A bag is a ROS 1 bag of version 2.0, an SQLite file or an "
            "MCAP file; if its beginning is damaged, nothing in it can be found"
        )
    yield from storage(path, types, contents)


def _compressed(path: Path, types: Collection[str], contents: BagContents) -> Iterator[Stored]:
    """Read a bag file that was compressed as a whole (.db3.zstd)."""
    with NamedTemporaryFile(suffix=path.stem) as copy:
        with path.open("rb") as file:
            try:
                zstandard.ZstdDecompressor().copy_stream(file, copy)
            except zstandard.ZstdError as error:
                contents.damage.append(f"the compression is damaged ({error}); the rest is lost")
        copy.flush()
        yield from stored_messages(Path(copy.name), types, contents)


def full_name(name: str) -> str:
    """Return a message type with the part `msg` that ROS 1 leaves out.

    >>> full_name("nav_msgs/Odometry")
    'nav_msgs/msg/Odometry'
    """
    package, _, rest = name.partition("/")
    return name if rest.startswith("msg/") else f"{package}/msg/{rest}"


# --- SQLite ---


def _sqlite(path: Path, types: Collection[str], contents: BagContents) -> Iterator[Stored]:
    with closing(sqlite3.connect(f"file:{quote(str(path))}?immutable=1", uri=True)) as file:
        file.execute("PRAGMA writable_schema = ON")  # else SQLite refuses a file that is shorter than it says
        file.text_factory = lambda text: text.decode(errors="replace")
        try:
            rows = file.execute("SELECT id, name, type, serialization_format FROM topics").fetchall()
        except sqlite3.DatabaseError as error:
            raise NoSource(f"{path} is not a bag, or its beginning is damaged: {error}") from error
        definitions = _definitions(file)
        topics = {
            number: BagTopic(str(name), str(kind), str(encoding), *definitions.get(kind, ("", False)))
            for number, name, kind, encoding in rows
        }
        contents.topics |= set(topics.values())
        wanted = [number for number, topic in topics.items() if topic.type in types]
        marks = ", ".join("?" * len(wanted))
        count = 0
        try:  # without an order, SQLite reads row by row, up to the damage
            query = f"SELECT topic_id, timestamp, data FROM messages WHERE +topic_id IN ({marks})"
            for number, stamp, data in file.execute(query, wanted):
                if isinstance(stamp, int) and isinstance(data, bytes):
                    compressed = data.startswith(ZSTD)
                    yield topics[number], stamp, zstandard.decompress(data, MOST_BYTES) if compressed else data
                    count += 1
        except (sqlite3.DatabaseError, zstandard.ZstdError) as error:
            contents.damage.append(f"damaged after {count} messages ({error}); the rest is lost")


def _definitions(file: sqlite3.Connection) -> dict[str, tuple[str, bool]]:
    """Return the definition of each message type, and whether it is IDL. Bags of early versions have none."""
    try:
        rows = file.execute("SELECT topic_type, encoded_message_definition, encoding FROM message_definitions")
        return {str(name): (str(text), "idl" in str(encoding)) for name, text, encoding in rows}
    except sqlite3.DatabaseError:
        return {}


# --- MCAP ---


def _mcap(path: Path, types: Collection[str], contents: BagContents) -> Iterator[Stored]:
    topics: dict[LogChannel, BagTopic] = {}
    with path.open("rb") as file:
        for item in records(file, path.stat().st_size):
            if isinstance(item, DamagedBytes):
                contents.damage.append(str(item))
            elif type(item) is tuple:
                channel, received, _, payload = item
                topic = topics.get(channel)
                if topic is None:
                    topic = topics[channel] = _mcap_topic(channel)
                    contents.topics.add(topic)
                if topic.type in types:
                    yield topic, received, payload


def _mcap_topic(channel: LogChannel) -> BagTopic:
    schema, encoding = channel.schema, channel.channel.message_encoding if channel.channel else ""
    if schema is None:
        return BagTopic(channel.topic, "", encoding)
    text = schema.data.decode(errors="replace")
    return BagTopic(channel.topic, full_name(schema.name), encoding, text, "idl" in schema.encoding)


# --- ROS 1: http://wiki.ros.org/Bags/Format/2.0 ---

MESSAGE, CHUNK, CONNECTION = b"\2", b"\5", b"\7"  # kinds of records
UNPACK: dict[bytes, Callable[[bytes], bytes]] = {
    b"none": bytes,
    b"bz2": lambda data: bz2.BZ2Decompressor().decompress(data, MOST_BYTES),
    b"lz4": lambda data: bytes(lz4.frame.LZ4FrameDecompressor().decompress(data, MOST_BYTES)),
}


def _ros1(path: Path, types: Collection[str], contents: BagContents) -> Iterator[Stored]:
    topics: dict[bytes, BagTopic] = {}
    with path.open("rb") as file:
        file.seek(len(ROS1_MAGIC))
        try:
            for header, data in _ros1_records(file, path.stat().st_size):
                if header.get(b"op") != CHUNK:
                    yield from _ros1_message(header, data, topics, types)
                    continue
                try:
                    chunk = UNPACK[header[b"compression"]](data)
                    for inner, payload in _ros1_records(BytesIO(chunk), len(chunk)):
                        yield from _ros1_message(inner, payload, topics, types)
                except BROKEN as error:
                    contents.damage.append(
                        f"the chunk before byte {file.tell()} is damaged ({error}); its rest is lost"
                    )
        except BROKEN as error:
            lost = path.stat().st_size - file.tell()
            contents.damage.append(f"{error}: reading ends there, {lost} bytes before the end; the rest is lost")
    contents.topics |= set(topics.values())


def _ros1_records(file: IO[bytes], size: int) -> Iterator[tuple[dict[bytes, bytes], bytes]]:
    """Yield the header and the data of each record, also the beginning of one that is cut off: then raise `BROKEN`."""
    while file.tell() < size:
        at = file.tell()
        header = _ros1_fields(file.read(_length(file, size)))
        length = _length(file, size)
        data = file.read(length)
        yield header, data
        if len(data) < length:
            raise EOFError(f"the record at byte {at} is cut off")


def _length(file: IO[bytes], size: int) -> int:
    length = int.from_bytes(file.read(4), "little")
    if not 0 < length + file.tell() <= max(size, MOST_BYTES):
        raise EOFError(f"a record declares {length} bytes")
    return length


def _ros1_fields(header: bytes) -> dict[bytes, bytes]:
    fields, at = {}, 0
    while at + 4 <= len(header):
        length = int.from_bytes(header[at : at + 4], "little")
        name, _, value = header[at + 4 : at + 4 + length].partition(b"=")
        fields[name] = value
        at += 4 + length
    return fields


def _ros1_message(
    header: dict[bytes, bytes], data: bytes, topics: dict[bytes, BagTopic], types: Collection[str]
) -> Iterator[Stored]:
    """Yield the message of a record, or add its topic to `topics`."""
    kind = header.get(b"op")
    if kind == CONNECTION:
        about = {name: value.decode(errors="replace") for name, value in _ros1_fields(data).items()}
        name = header[b"topic"].decode(errors="replace")
        definition = about.get(b"message_definition", "")
        topics[header[b"conn"]] = BagTopic(name, full_name(about.get(b"type", "")), ROS1, definition)
    elif kind == MESSAGE and (topic := topics[header[b"conn"]]).type in types:
        seconds, nanoseconds = TIME.unpack(header[b"time"])
        yield topic, seconds * 1_000_000_000 + nanoseconds, data


STORAGES: dict[bytes, Callable[[Path, Collection[str], BagContents], Iterator[Stored]]] = {
    ROS1_MAGIC: _ros1,
    b"SQLite format 3\0": _sqlite,
    MCAP_MAGIC: _mcap,
    ZSTD: _compressed,
}

"""Reads the logs of runs back, the damaged ones too: whatever a killed recorder left is given, and what is cut is said.

for record in read("runs/demo"):
    print(record.key, record.message)
"""

from __future__ import annotations

import os
import struct
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO, Any

import zstandard
from google.protobuf.message import DecodeError, Message
from mcap.exceptions import McapError
from mcap.records import Attachment, Channel, Chunk, McapRecord, Metadata, Schema
from mcap.records import Message as Stored
from mcap.stream_reader import StreamReader, breakup_chunk

from logs.segment import number_of
from messaging.topics import TOPICS

Paths = str | os.PathLike[str] | Iterable[str | os.PathLike[str]]

TYPES: dict[str, type[Message]] = {topic.message.DESCRIPTOR.full_name: topic.message for topic in TOPICS}
NAMES: dict[str, str] = {topic.key.split("/", 1)[0]: topic.name for topic in TOPICS}
DAMAGE = (McapError, struct.error, ValueError, zstandard.ZstdError)


class LogError(Exception):
    """A log cannot be read."""


class NoLog(LogError):
    """There is no log at the path."""


class NotALog(LogError):
    """The file is not an MCAP file."""


@dataclass(frozen=True)
class Record:
    """One message of a log."""

    topic: str  # its name in messaging/topics.py, e.g. "step"
    key: str  # e.g. "step/ground/actor-0"
    message: Any
    log_time: int  # ns since the Unix epoch, when it was received
    publish_time: int  # ns: simulated time if the message has one, else when it was published


@dataclass(frozen=True)
class Cut:
    """A file that does not end as it should: the recorder was killed, or its disk was full."""

    path: Path
    lost: int  # bytes at the end that cannot be read; 0: only the summary is missing
    reason: str

    def __str__(self) -> str:
        what = f"{self.lost} bytes at its end cannot be read" if self.lost else "it ends without a summary"
        return f"{self.path}: {what} ({self.reason})"


@dataclass
class Log:
    """The segments of one or more runs, in order. The other attributes fill up while it is iterated over."""

    paths: tuple[Path, ...]
    metadata: dict[str, dict[str, str]] = field(default_factory=dict)
    attachments: dict[str, bytes] = field(default_factory=dict)
    cuts: list[Cut] = field(default_factory=list)
    malformed: int = 0  # messages that are not of their type

    def __iter__(self) -> Iterator[Record]:
        for path in self.paths:
            with path.open("rb") as file:
                yield from self._records(path, file)

    def _records(self, path: Path, file: IO[bytes]) -> Iterator[Record]:
        """The messages of one file, front to back; that needs no summary, so it works for every file."""
        schemas: dict[int, Schema] = {}
        channels: dict[int, Channel] = {}
        for item in self._intact(path, file):
            if isinstance(item, Metadata):
                self.metadata[item.name] = dict(item.metadata)
            elif isinstance(item, Attachment):
                self.attachments[item.name] = item.data
            elif isinstance(item, Schema):
                schemas[item.id] = item
            elif isinstance(item, Channel):
                channels[item.id] = item
            elif isinstance(item, Stored):
                channel = channels[item.channel_id]
                schema = schemas.get(channel.schema_id)
                kind = TYPES.get(schema.name) if schema is not None else None
                if kind is not None:  # others may have added channels of their own
                    try:
                        message = kind.FromString(item.data)
                    except DecodeError:
                        self.malformed += 1
                        continue
                    root = channel.topic.split("/", 1)[0]
                    yield Record(NAMES.get(root, root), channel.topic, message, item.log_time, item.publish_time)

    def _intact(self, path: Path, file: IO[bytes]) -> Iterator[McapRecord]:
        """The records of the file, those within chunks too, up to the first that is not whole."""
        size = path.stat().st_size
        good = 0  # bytes up to the end of the last whole record
        try:
            for item in StreamReader(file, emit_chunks=True).records:
                yield from breakup_chunk(item, validate_crc=True) if isinstance(item, Chunk) else [item]
                good = file.tell()
        except DAMAGE as error:
            if size > 0 and good == 0:
                raise NotALog(f"{path} is not an MCAP file: {error}") from error
            self.cuts.append(Cut(path, size - good, str(error) or type(error).__name__))


def find(paths: Paths) -> tuple[Path, ...]:
    """The log files meant: all of a folder; for run.mcap its later segments run.1.mcap … too; else the file itself.

    Raises:
        NoLog: there is none.
    """
    asked = [paths] if isinstance(paths, str | os.PathLike) else list(paths)
    found: dict[Path, None] = {}
    for path in map(Path, asked):
        if path.is_dir():
            files = list(path.glob("*.mcap"))
        elif path.is_file():
            name, number = number_of(path)
            later = path.parent.glob("*.mcap") if number == 0 else ()
            files = [path, *(other for other in later if number_of(other)[0] == name and other != path)]
        else:
            files = []
        if not files:
            raise NoLog(f"no log at {path}: give an .mcap file or the folder of a run")
        found.update(dict.fromkeys(sorted(files, key=number_of)))
    return tuple(found)


def open_log(paths: Paths) -> Log:
    """The log at `paths`, one or many files or folders, to iterate over.

    Raises:
        NoLog: there is none.
        NotALog: while iterating: a file is something else.
    """
    return Log(find(paths))


def read(paths: Paths) -> Iterator[Record]:
    """The messages of the log at `paths`, in the order in which they were recorded; as `open_log` where it fails."""
    yield from open_log(paths)

"""Write one MCAP file of a run: run.mcap, then run_0001.mcap, run_0002.mcap ….

A run has several files if it was resumed, the recorder restarted, the disk was full, or a file grew too long. Each file
can be read without the others.
"""

from __future__ import annotations

import contextlib
import fcntl
import itertools
import os
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO

import mcap.writer
from google.protobuf.message import Message
from mcap.records import Metadata as McapMetadata
from mcap.well_known import MessageEncoding, SchemaEncoding
from mcap_protobuf.schema import build_file_descriptor_set

from brakeline.errors import NotMcap
from brakeline.logs.mcap_container import CHANNELS, OWN_SCHEMAS, records
from brakeline.messaging.steady_clock import steady_time_ns

NO_SCHEMA = 0
CHUNK = 256 * 1024  # bytes before compression; a flush ends a chunk early
MOST_CHANNELS = 2**16 - 1  # per file: MCAP numbers channels with two bytes
TIME_LIMIT = 2**64  # ns: MCAP stores smaller times only

Metadata = Mapping[str, Mapping[str, str]]
Attachments = Mapping[str, bytes]  # file contents by name, e.g. model sets

ABOUT = "brakeline"  # metadata of each log
CLOCK, STEADY = "clock", "steady"  # name and value of an entry of the metadata
SEGMENT = "segment"  # name of an entry of the metadata: the number of the file among those of its run
TIMES = {
    CLOCK: STEADY,
    "log_time": "ns since the Unix epoch, when the recorder received the message, by the clock at the recorder's "
    "start: later jumps of the computer's clock do not show",
    "publish_time": "ns of simulated (or the robot's) time where the message has one, header.time > 0; "
    "else ns since the Unix epoch, when it was published, header.wall_time",
    "topic": "the key on the bus without its prefix",
    "sequence": "header.sequence: from 1 per topic and process start; gaps are losses",
}


@dataclass(frozen=True)
class Entry:
    """One message to store, as the bytes from the wire.

    Attributes:
        type: the message's class, or the name of a self-describing encoding.
        log_time, publish_time: ns.

    Raises:
        ValueError: MCAP cannot store a time.
    """

    key: str
    type: type[Message] | str
    payload: bytes
    log_time: int
    publish_time: int
    sequence: int

    def __post_init__(self) -> None:
        if not (0 <= self.log_time < TIME_LIMIT and 0 <= self.publish_time < TIME_LIMIT):
            raise ValueError(f"{self.key}: MCAP cannot store the times {self.log_time} ns and {self.publish_time} ns")


def name_of(path: Path | str, number: int) -> str:
    """Return the file name of a segment: run.mcap for 0, then run_0001.mcap, run_0002.mcap …."""
    path = Path(path)
    return f"{path.stem}_{number:04}{path.suffix}" if number else path.name


def number_of(path: Path) -> tuple[str, int]:
    """Return the run's name and the segment's number: ("run", 2) for run_0002.mcap, ("run", 0) for run.mcap.

    A name such as flight_2025.mcap looks like a segment's. So the number in the file itself decides, if it has one.
    """
    numbered = re.fullmatch(r"(.+?)(?:_(\d{4,5})|\.(\d+))", path.stem)  # run.2.mcap: the names of earlier versions
    if numbered is None:
        return path.stem, 0
    number = int(numbered[2] or numbered[3])
    return (numbered[1], number) if _recorded_number(path) in (None, number) else (path.stem, 0)


def _recorded_number(path: Path) -> int | None:
    """Return the segment's number in the metadata, which follow the header; None if they state none."""
    with contextlib.suppress(OSError, NotMcap, ValueError), path.open("rb") as file:
        for item in itertools.islice(records(file, path.stat().st_size), 2):
            if isinstance(item, McapMetadata) and item.name == ABOUT:
                number = item.metadata.get(SEGMENT, "")
                return int(number) if number.isdecimal() else None
    return None


def being_written(path: Path) -> bool:
    """Return whether a recorder is writing to the file."""
    with path.open("rb") as file:
        try:
            fcntl.flock(file, fcntl.LOCK_SH | fcntl.LOCK_NB)
        except BlockingIOError:
            return True
        except OSError:  # a file system without locks
            return False
    return False


class BufferedFile:
    """A file that `flush` extends by all waiting bytes or by none, so that a full disk leaves no part of a record."""

    def __init__(self, file: BinaryIO) -> None:
        """Wrap a file, which must be unbuffered: otherwise an error would come late, and again on closing."""
        self._file = file
        self._waiting = bytearray()
        self._written = 0

    def write(self, data: bytes) -> int:
        self._waiting += data
        return len(data)

    def tell(self) -> int:
        return self._written + len(self._waiting)

    def flush(self) -> None:
        """Write all waiting bytes.

        Raises:
            OSError: the disk is full or broken; no waiting byte is in the file.
        """
        # Without `with`, the traceback of an error would hold the view, and `write` would fail.
        with memoryview(self._waiting) as waiting:
            try:
                done = 0
                while done < len(waiting):
                    done += self._file.write(waiting[done:])
            except OSError:
                self._file.truncate(self._written)
                self._file.seek(self._written)
                raise
        self._written += len(self._waiting)
        self._waiting = bytearray()


class Segment:
    """Writes one MCAP file: one channel per key, self-contained protobuf schemas, zstd chunks.

    Attributes:
        empty: the file has no message.
    """

    def __init__(
        self,
        path: Path,
        file: BinaryIO,
        metadata: Metadata,
        attachments: Attachments | None = None,
        number: int = 0,
    ) -> None:
        """Start the file and write its metadata and attachments.

        Args:
            file: `path`, opened for writing without a buffer.
            number: of the file among those of its run, from 0.

        Raises:
            OSError: the disk is full or broken.
        """
        self.path, self._file = path, file
        self._spool = BufferedFile(file)
        output: Any = self._spool  # the writer uses `write`, `tell` and `flush`
        self._writer: Any = mcap.writer.Writer(output, chunk_size=CHUNK, enable_data_crcs=True)
        self._schemas: dict[str, int] = {}
        self._channels: dict[str, int] = {}
        self.empty = True
        self._writer.start(profile="", library="brakeline")
        about = TIMES | {SEGMENT: str(number)}
        for name, values in ((ABOUT, about), *metadata.items()):
            self._writer.add_metadata(name, dict(values))
        for name, data in (attachments or {}).items():
            now = steady_time_ns()
            self._writer.add_attachment(now, now, name, "application/octet-stream", data)
        self._writer.flush()  # type: ignore[no-untyped-call]

    @property
    def size(self) -> int:
        """Size of the file, bytes."""
        return self._spool.tell()

    def save(self, entries: Iterable[Entry]) -> int:
        """Write the entries and flush the file, so that only a power cut can lose them.

        Returns:
            How many entries were left out, because their channels exceed the limit of a file.

        Raises:
            OSError: the disk is full or broken. No entry is in the file; call `abandon`.
        """
        left_out, entries = 0, list(entries)
        self._declare(entries)
        for entry in entries:
            if len(self._channels) >= MOST_CHANNELS and entry.key not in self._channels:
                left_out += 1
                continue
            self._writer.add_message(
                channel_id=self._channel(entry.key, entry.type),
                log_time=entry.log_time,
                data=entry.payload,
                publish_time=entry.publish_time,
                sequence=entry.sequence & 0xFFFFFFFF,
            )
        self._writer.flush()
        self.empty = False
        return left_out

    def finish(self, sync: bool = False) -> None:
        """Write the summary and close the file.

        Args:
            sync: wait until the file is on the disk, so that a power cut cannot lose it.

        Raises:
            OSError: there is no space for the summary; all messages are in the file.
        """
        try:
            self._writer.finish()
            self._spool.flush()
            if sync:
                os.fsync(self._file.fileno())
        finally:
            self._file.close()

    def abandon(self) -> None:
        """Close the file without a summary. Remove a file without a message."""
        self._file.close()
        if self.empty:
            self.path.unlink(missing_ok=True)

    def _declare(self, entries: Sequence[Entry]) -> None:
        """Register the channels that begin with these entries. Write those of our own messages outside the chunks."""
        own: dict[str, str] = {}
        for key, kind in {entry.key: entry.type for entry in entries}.items():
            if key not in self._channels and len(self._channels) < MOST_CHANNELS:
                number = self._channel(key, kind)
                if not isinstance(kind, str) and kind.DESCRIPTOR.full_name.startswith(OWN_SCHEMAS):
                    own[str(number)] = key
        if own:
            self._writer.add_metadata(CHANNELS, own)

    def _channel(self, key: str, kind: type[Message] | str) -> int:
        if key not in self._channels:
            encoding = kind if isinstance(kind, str) else MessageEncoding.Protobuf
            self._channels[key] = self._writer.register_channel(key, encoding, self._schema(kind))
        return self._channels[key]

    def _schema(self, kind: type[Message] | str) -> int:
        if isinstance(kind, str):
            return NO_SCHEMA
        name = kind.DESCRIPTOR.full_name
        if name not in self._schemas:
            self._schemas[name] = self._writer.register_schema(name, SchemaEncoding.Protobuf, schema_of(kind))
        return self._schemas[name]


def schema_of(kind: type[Message]) -> bytes:
    """Return the schema of a message type, with the types of its fields."""
    return bytes(build_file_descriptor_set(kind).SerializeToString())


def open_segment(run: Path, metadata: Metadata, attachments: Attachments | None = None) -> Segment:
    """Create the first segment of the run that does not exist yet.

    Raises:
        OSError: the file cannot be created or the disk is full; no file is left behind.
    """
    run.parent.mkdir(parents=True, exist_ok=True)
    for number in itertools.count():
        path = run.with_name(name_of(run, number))
        try:
            file = os.fdopen(os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o644), "wb", buffering=0)
        except FileExistsError:
            continue
        with contextlib.suppress(OSError):  # a file system without locks
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)  # held until the file is closed or the process ends
        try:
            return Segment(path, file, metadata, attachments, number)
        except OSError:
            file.close()
            path.unlink(missing_ok=True)
            raise
    raise AssertionError("unreachable: the names never end")

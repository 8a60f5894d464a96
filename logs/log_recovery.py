"""Repair a damaged log: write everything that can be read to a file with a summary, which every MCAP tool opens.

The new file has the same messages, channels, schemas, metadata and attachments. The damaged file stays beside it as
run.mcap.damaged.
"""

from __future__ import annotations

import os
from dataclasses import dataclass, field
from itertools import chain
from pathlib import Path
from typing import IO, Any

import mcap.writer
from mcap.records import Attachment, Header, Metadata
from mcap.well_known import MessageEncoding, SchemaEncoding

from brakeline.errors import LogError, NotMcap
from brakeline.logs.mcap_container import DamagedBytes, LogChannel, records
from brakeline.logs.segment import CHUNK, being_written, schema_of
from brakeline.messaging.topics import topic_of

DAMAGED = ".damaged"
UNFINISHED = ".recovering"


@dataclass
class Recovery:
    """Result of repairing one file.

    Attributes:
        path: the repaired file.
        kept: where the damaged file is now, or the intact one that was copied; None if nothing was done.
        messages: number of messages in the file.
        last: receipt of the last message, ns since the Unix epoch.
        lost: bytes that could not be read.
        cuts: descriptions of the damage.
    """

    path: Path
    kept: Path | None = None
    messages: int = 0
    last: int = 0
    lost: int = 0
    cuts: list[str] = field(default_factory=list)

    def __str__(self) -> str:
        if self.kept is None:
            return f"{self.path}: intact, {self.messages} messages; nothing to do"
        if not self.cuts:
            return f"{self.path}: {self.messages} messages, a copy of {self.kept}, which is intact"
        damage = "; ".join(self.cuts)
        return f"{self.path}: {self.messages} messages recovered; {damage}; the damaged file is {self.kept}"


def recover(path: Path, out: Path | None = None) -> Recovery:
    """Repair a log file in place or to `out`. An intact file stays as it is, or is copied to `out`.

    The repaired file gets its name only when it is complete, so that an interruption loses nothing.

    Raises:
        LogError: a recorder is writing to the file, or it is not an MCAP file.
        FileExistsError: `out` or an earlier damaged file would be overwritten.
        OSError: the disk is full or broken.
    """
    if being_written(path):
        raise LogError(f"{path} is being recorded: stop its recorder first")
    target, damaged = out or path, path if out is not None else path.with_name(path.name + DAMAGED)
    if out is not None and out.exists():
        raise FileExistsError(f"{out} exists already")
    beside = target.with_name(target.name + UNFINISHED)
    result = Recovery(target)
    try:
        with path.open("rb") as source, beside.open("wb") as sink:
            _copy(source, path.stat().st_size, sink, result)
            sink.flush()
            os.fsync(sink.fileno())
        if not result.cuts and out is None:
            return result
        if out is None:
            if damaged.exists():
                raise FileExistsError(f"{damaged} exists already: move it away")
            try:
                os.link(path, damaged)  # a file with the log's name exists at every moment
            except PermissionError:  # a file system without links
                path.rename(damaged)
        beside.replace(target)
    except NotMcap as error:
        raise LogError(
            f"{path} is not an MCAP file: {error}. `brakeline import` reads damaged logs of other formats as far as "
            "they go, without a repair"
        ) from error
    finally:
        beside.unlink(missing_ok=True)
    result.kept = damaged
    return result


def _copy(source: IO[bytes], size: int, sink: IO[bytes], result: Recovery) -> None:
    writer: Any = mcap.writer.Writer(sink, chunk_size=CHUNK)
    numbers: dict[LogChannel, int] = {}
    schemas: dict[tuple[str, bytes], int] = {}
    items = records(source, size)
    first = next(items, None)
    # The profile, such as `ros2`, says whose messages the file holds.
    writer.start(profile=first.profile if isinstance(first, Header) else "", library="brakeline recover")
    for item in chain(() if first is None else (first,), items):
        if type(item) is tuple:
            channel, log_time, publish_time, payload = item
            if channel not in numbers:
                numbers[channel] = _register(writer, channel, schemas)
            writer.add_message(numbers[channel], log_time, payload, publish_time, channel.sequence)
            result.messages += 1
            result.last = max(result.last, log_time)
        elif isinstance(item, DamagedBytes):
            result.lost += item.lost
            result.cuts.append(str(item))
        elif isinstance(item, Metadata):
            writer.add_metadata(item.name, item.metadata)
        elif isinstance(item, Attachment):
            writer.add_attachment(item.create_time, item.log_time, item.name, item.media_type, item.data)
    writer.finish()


def _register(writer: Any, channel: LogChannel, schemas: dict[tuple[str, bytes], int]) -> int:
    """Return the number of a channel in the new file; register its schema if needed."""
    schema, record = channel.schema, channel.channel
    assert record is not None, "the container has set it"
    number, encoding, topic = 0, SchemaEncoding.Protobuf, topic_of(record.topic)  # 0: no schema
    content = None if schema is None else (schema.name, schema.data)
    if schema is not None:
        encoding = schema.encoding
    elif record.message_encoding == MessageEncoding.Protobuf and topic is not None:  # its declaration is lost
        content = topic.message.DESCRIPTOR.full_name, schema_of(topic.message)
    if content is not None:
        if content not in schemas:
            schemas[content] = writer.register_schema(content[0], encoding, content[1])
        number = schemas[content]
    return int(writer.register_channel(record.topic, record.message_encoding, number, record.metadata))

"""Makes a damaged log whole: all that can be read of it, in a file with a summary that every MCAP tool opens.

Messages, channels, schemas, metadata and attachments are taken over as they are, those of others' channels too. The
damaged file is kept beside the new one, as run.mcap.damaged.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO, Any

import mcap.writer
from mcap.records import Attachment, Metadata

from brakeline.logs.mcap_container import DamagedBytes, LogChannel, NotMcap, records
from brakeline.logs.reader import LogError, NotALog
from brakeline.logs.segment import CHUNK, being_written

DAMAGED = ".damaged"
UNFINISHED = ".recovering"


class BeingRecorded(LogError):
    """A recorder writes to the file now: there is nothing to recover before it has ended."""


@dataclass
class Recovery:
    """What became of a file."""

    path: Path  # the whole file
    kept: Path | None = None  # the damaged one; None: it was whole, and nothing was done
    messages: int = 0
    last: int = 0  # ns since the Unix epoch, receipt of the last message
    lost: int = 0  # bytes that could not be read
    cuts: list[str] = field(default_factory=list)

    def __str__(self) -> str:
        if self.kept is None:
            return f"{self.path}: whole, {self.messages} messages; nothing to do"
        said = "; ".join(self.cuts)
        return f"{self.path}: {self.messages} messages recovered; {said}; the damaged file is {self.kept}"


def recover(path: Path, out: Path | None = None) -> Recovery:
    """Recover a log file in its place, or to `out`. A whole file is left as it is (but copied to `out`).

    It is written beside, and renamed when it is complete: whatever happens meanwhile, nothing is lost.

    Raises:
        BeingRecorded: a recorder holds it.
        NotALog: it is something else.
        FileExistsError: `out`, or a damaged file from before, would be overwritten.
        OSError: there is no space.
    """
    if being_written(path):
        raise BeingRecorded(f"{path} is being recorded: end its recorder first")
    target, kept = out or path, path if out is not None else path.with_name(path.name + DAMAGED)
    if out is not None and out.exists():
        raise FileExistsError(f"{out} exists already")
    beside = target.with_name(target.name + UNFINISHED)
    found = Recovery(target)
    try:
        with path.open("rb") as source, beside.open("wb") as sink:
            _copy(source, path.stat().st_size, sink, found)
            sink.flush()
            os.fsync(sink.fileno())
        if not found.cuts and out is None:
            return found
        if out is None:
            if kept.exists():
                raise FileExistsError(f"{kept} exists already: move it away")
            try:
                os.link(path, kept)  # so that there is a file under the log's name at every moment
            except PermissionError:  # a file system without links
                path.rename(kept)
        beside.replace(target)
    except NotMcap as error:
        raise NotALog(f"{path} is not an MCAP file: {error}") from error
    finally:
        beside.unlink(missing_ok=True)
    found.kept = kept
    return found


def _copy(source: IO[bytes], size: int, sink: IO[bytes], found: Recovery) -> None:
    writer: Any = mcap.writer.Writer(sink, chunk_size=CHUNK)
    writer.start(profile="", library="brakeline recover")
    numbers: dict[LogChannel, int] = {}
    schemas: dict[tuple[str, bytes], int] = {}
    for item in records(source, size, lambda key, schema: LogChannel(key, key, None)):
        if type(item) is tuple:
            series, log_time, publish_time, payload = item
            if series not in numbers:
                numbers[series] = _register(writer, series, schemas)
            writer.add_message(numbers[series], log_time, payload, publish_time, series.sequence)
            found.messages += 1
            found.last = max(found.last, log_time)
        elif isinstance(item, DamagedBytes):
            found.lost += item.lost
            found.cuts.append(str(item))
        elif isinstance(item, Metadata):
            writer.add_metadata(item.name, item.metadata)
        elif isinstance(item, Attachment):
            writer.add_attachment(item.create_time, item.log_time, item.name, item.media_type, item.data)
    writer.finish()


def _register(writer: Any, series: LogChannel, schemas: dict[tuple[str, bytes], int]) -> int:
    """The number of a channel in the new file, and of its schema."""
    schema, channel = series.schema, series.channel
    assert channel is not None, "the container fills it in"
    number = 0  # no schema
    if schema is not None:
        place = schema.name, schema.data
        if place not in schemas:
            schemas[place] = writer.register_schema(schema.name, schema.encoding, schema.data)
        number = schemas[place]
    return int(writer.register_channel(channel.topic, channel.message_encoding, number, channel.metadata))


def recover_all(paths: tuple[Path, ...]) -> Iterator[Recovery]:
    """Recover each file in its place. Raises as `recover`."""
    for path in paths:
        yield recover(path)

"""Reads the logs of runs back, the damaged ones too: whatever a killed recorder left is given, and what is cut is said.

for record in read("runs/demo"):
    print(record.key, record.message)
"""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from itertools import groupby
from pathlib import Path
from typing import Any, NamedTuple

from google.protobuf.message import DecodeError, Message
from mcap.records import Attachment, Metadata

from brakeline.logs.mcap_container import DamagedBytes, LogChannel, NotMcap, Row, records
from brakeline.logs.recorded_robots import RecordedRobots
from brakeline.logs.segment import being_written, name_of, number_of
from brakeline.messaging.message_checks import Implausible, check
from brakeline.messaging.topics import TOPICS

Paths = str | os.PathLike[str] | Iterable[str | os.PathLike[str]]

TYPES: dict[str, type[Message]] = {topic.message.DESCRIPTOR.full_name: topic.message for topic in TOPICS}
NAMES: dict[str, str] = {topic.key.split("/", 1)[0]: topic.name for topic in TOPICS}


class LogError(Exception):
    """A log cannot be read."""


class NoLog(LogError):
    """There is no log at the path."""


class NotALog(LogError):
    """The file is not an MCAP file."""


class Record(NamedTuple):
    """One message of a log."""

    topic: str  # its name in messaging/topics.py, e.g. "step"
    key: str  # e.g. "step/ground/actor-0"
    message: Any
    log_time: int  # ns since the Unix epoch, when it was received
    publish_time: int  # ns: simulated time if the message has one, else when it was published


@dataclass(frozen=True)
class DamagedFile:
    """A file that is not as it should be: the recorder was killed, its disk was full, or bytes were changed."""

    path: Path
    lost: int  # bytes that cannot be read; 0: only the summary is missing
    reason: str
    at: int | None = None  # where in the file these bytes are; None: at its end

    def __str__(self) -> str:
        if not self.lost:
            return f"{self.path}: it ends without a summary ({self.reason})"
        where = "its end" if self.at is None else f"byte {self.at}"
        return f"{self.path}: {self.lost} bytes at {where} cannot be read ({self.reason})"


@dataclass(frozen=True)
class MissingSegment:
    """A segment that must have been there: later ones are."""

    path: Path

    def __str__(self) -> str:
        return f"{self.path}: this segment is missing, with all that was recorded in it"


@dataclass
class Segment:
    """What was found in a file, once it was read."""

    path: Path
    size: int  # bytes
    messages: int = 0
    start: int = 0  # ns since the Unix epoch: first and last time of receipt; 0 without messages
    end: int = 0
    recording: bool = False  # somebody writes to it now

    def took(self, log_time: int) -> None:
        self.messages += 1
        if log_time > self.end:
            self.end = log_time
            self.start = self.start or log_time
        elif log_time < self.start:
            self.start = log_time


@dataclass
class Log:
    """The segments of one or more runs, in order. The other attributes fill up while it is iterated over."""

    paths: tuple[Path, ...]
    metadata: dict[str, dict[str, str]] = field(default_factory=dict)  # the latest of each name
    attachments: dict[str, bytes] = field(default_factory=dict)  # likewise: the model sets of the run's start
    cuts: list[DamagedFile | MissingSegment] = field(default_factory=list)
    malformed: int = 0  # messages that are not of their type, or say what nobody can handle
    segments: list[Segment] = field(default_factory=list)
    robots: RecordedRobots = field(default_factory=RecordedRobots)

    def __iter__(self) -> Iterator[Record]:
        for series, message, log_time, publish_time in self.decoded():
            yield Record(series.topic, series.key, message, log_time, publish_time)

    def decoded(self) -> Iterator[tuple[LogChannel, Any, int, int]]:
        """As iterating, with plain tuples (channel, message, log_time, publish_time): faster."""
        for series, log_time, publish_time, payload in self.rows():
            try:
                message = series.decode(payload)
                check(message)
            except (DecodeError, Implausible):
                self.malformed += 1
                continue
            yield series, message, log_time, publish_time

    def rows(self) -> Iterator[Row]:
        """The messages of types that we know as they are stored: (channel, log_time, publish_time, payload)."""
        self.cuts += absent(self.paths)
        for path in self.paths:
            yield from self._rows_of(path)

    def _rows_of(self, path: Path) -> Iterator[Row]:
        """The messages of one file, front to back; that needs no summary, so it works for every file."""
        about = Segment(path, path.stat().st_size, recording=being_written(path))
        self.segments.append(about)
        try:
            with path.open("rb") as file:
                for item in records(file, about.size, self._series):
                    if type(item) is tuple:
                        about.took(item[1])
                        if item[0].known:  # others may have added channels of their own
                            yield item
                    elif isinstance(item, DamagedBytes):
                        self._note(about, item)
                    elif isinstance(item, Metadata):
                        self.metadata[item.name] = dict(item.metadata)
                        if item.name == "robots":
                            self.robots.describe(item.metadata)
                    elif isinstance(item, Attachment):
                        self.attachments[item.name] = item.data
        except NotMcap as error:
            raise NotALog(f"{path} is not an MCAP file: {error}") from error

    def _note(self, about: Segment, damage: DamagedBytes) -> None:
        reason = "it is being recorded" if about.recording and damage.at_end else damage.reason
        self.cuts.append(DamagedFile(about.path, damage.lost, reason, None if damage.at_end else damage.at))

    @staticmethod
    def _series(key: str, schema: str) -> LogChannel:
        kind, root = TYPES.get(schema), key.split("/", 1)[0]
        return LogChannel(NAMES.get(root, root), key, None if kind is None else kind.FromString)


def find(paths: Paths) -> tuple[Path, ...]:
    """The log files meant: all of a folder; for run.mcap its later segments run_0001.mcap … too; else the file itself.

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


def by_run(paths: Sequence[Path]) -> dict[str, tuple[Path, ...]]:
    """The files that belong to one run, under a name for it: its folder, and the file's name unless that is `run`.

    A resumed or restarted run has several files; they come in the order in which they were recorded.
    """
    runs: dict[str, tuple[Path, ...]] = {}
    for (folder, name), files in groupby(paths, key=lambda path: (path.parent, number_of(path)[0])):
        place = folder.resolve().name
        label = place if name == "run" else f"{place}/{name}"
        taken = sum(other == label or other.startswith(f"{label} (") for other in runs)
        runs[f"{label} ({taken + 1})" if taken else label] = tuple(files)
    return runs


def absent(paths: Sequence[Path]) -> list[DamagedFile | MissingSegment]:
    """The segments that are missing between those at `paths`: numbers that were left out."""
    found: list[DamagedFile | MissingSegment] = []
    for (folder, name), files in groupby(paths, key=lambda path: (path.parent, number_of(path)[0])):
        numbers = [number_of(path)[1] for path in files]
        if len(numbers) > 1:
            gone = sorted(set(range(numbers[-1])) - set(numbers))
            found += [MissingSegment(folder / name_of(f"{name}.mcap", number)) for number in gone]
    return found


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

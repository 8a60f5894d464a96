"""Read the logs of runs, also damaged ones. The reader returns every intact message and lists the damage.

for record in read("runs/demo"):
    print(record.key, record.message)
"""

from __future__ import annotations

import logging
import os
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from itertools import combinations, groupby, pairwise
from pathlib import Path
from shlex import quote
from typing import Any, NamedTuple

from google.protobuf.message import DecodeError, Message
from mcap.reader import make_reader
from mcap.records import Attachment, Metadata

from brakeline.errors import Implausible, LogError, NotMcap
from brakeline.logs.mcap_container import (
    BROKEN,
    MAGIC,
    DamagedBytes,
    LogChannel,
    Row,
    has_whole_summary,
    is_ros,
    records,
)
from brakeline.logs.recorded_robots import RecordedRobots
from brakeline.logs.run_clock import RunClock
from brakeline.logs.segment import ABOUT, CLOCK, STEADY, being_written, name_of, number_of
from brakeline.messaging.bus.stated_names import check_names
from brakeline.messaging.bus.topic_keys import names_of
from brakeline.messaging.message_checks import check
from brakeline.messaging.topics import TOPICS, topic_of

log = logging.getLogger("brakeline.logs")

Paths = str | os.PathLike[str] | Iterable[str | os.PathLike[str]]

TYPES: dict[str, type[Message]] = {topic.message.DESCRIPTOR.full_name: topic.message for topic in TOPICS}


class Record(NamedTuple):
    """One message of a log.

    Attributes:
        topic: the topic's name in messaging/topics.py, e.g. "step".
        key: e.g. "step/ground/actor-0".
        log_time: time of receipt, ns since the Unix epoch.
        publish_time: simulated time if the message has one, otherwise the time of publication, ns.
    """

    topic: str
    key: str
    message: Any
    log_time: int
    publish_time: int


@dataclass(frozen=True)
class MissingSegment:
    """Missing segments, one after the other, of a run that has later segments."""

    path: Path  # of the first one
    last: Path  # of the last one
    count: int = 1

    def __str__(self) -> str:
        if self.count == 1:
            return f"{self.path}: this segment is missing"
        return f"{self.path} to {self.last.name}: these {self.count} segments are missing"


@dataclass
class LogSegment:
    """Counts of one file, complete once it has been read."""

    path: Path
    size: int  # bytes
    messages: int = 0
    start: int = 0  # ns since the Unix epoch, first and last time of receipt; 0 without a message
    end: int = 0
    recording: bool = False  # a recorder is writing to the file

    def count(self, log_time: int) -> None:
        self.messages += 1
        if log_time > self.end:
            self.end = log_time
            self.start = self.start or log_time
        elif log_time < self.start:
            self.start = log_time


@dataclass(frozen=True)
class Damage:
    """What could not be read of a log.

    Attributes:
        cuts: one line for each damage or missing segment.
        malformed: number of messages that cannot be decoded or have impossible values.
    """

    cuts: list[str] = field(default_factory=list)
    malformed: int = 0

    @property
    def lines(self) -> list[str]:
        """One line for each damage, also for malformed messages."""
        counted = f"{self.malformed} messages cannot be decoded, or have impossible values"
        return [*self.cuts, *([counted] if self.malformed else [])]


@dataclass
class Log:
    """The segments of one or more runs, in order. Iterating over the log fills the other attributes.

    Attributes:
        metadata: the latest of each name.
        attachments: the latest of each name, e.g. the model sets at the start of the run.
        cuts: damage and missing segments.
        malformed: number of messages that cannot be decoded or have impossible values.
    """

    paths: tuple[Path, ...]
    metadata: dict[str, dict[str, str]] = field(default_factory=dict)
    attachments: dict[str, bytes] = field(default_factory=dict)
    cuts: list[DamagedBytes | MissingSegment] = field(default_factory=list)
    malformed: int = 0
    segments: list[LogSegment] = field(default_factory=list)
    clock: RunClock = field(default_factory=RunClock)  # `clock.at(log_time)` for each message in turn
    robots: RecordedRobots = field(default_factory=RecordedRobots)

    @property
    def damage(self) -> Damage:
        """What could not be read, once the log has been read."""
        return Damage([str(cut) for cut in self.cuts], self.malformed)

    def __iter__(self) -> Iterator[Record]:
        for channel, message, log_time, publish_time in self.decoded():
            yield Record(channel.topic, channel.key, message, log_time, publish_time)

    def decoded(self) -> Iterator[tuple[LogChannel, Any, int, int]]:
        """Yield (channel, message, log_time, publish_time) for each valid message: faster than iterating.

        A message that names another robot or process than its key is not valid, as for the processes that received it.
        """
        for channel, log_time, publish_time, payload in self.rows():
            try:
                message = channel.decode(payload)
                check(message, len(payload))
                check_names(channel.names, message)
            except (DecodeError, Implausible):
                self.malformed += 1
                continue
            yield channel, message, log_time, publish_time

    def rows(self) -> Iterator[Row]:
        """Yield (channel, log_time, publish_time, payload) for each message of a known type, without decoding it."""
        self.cuts += missing_segments(self.paths)
        for path in self.paths:
            yield from self._rows_of(path)

    def _rows_of(self, path: Path) -> Iterator[Row]:
        """Yield the messages of one file from front to back, which needs no summary.

        Raises:
            LogError: the file is not an MCAP file, or it is a ROS bag.
        """
        if is_ros(path):
            raise LogError(
                f"{path} is a ROS bag, not the log of a run: read it with `brakeline import {quote(str(path))}`"
            )
        segment = LogSegment(path, path.stat().st_size, recording=being_written(path))
        self.segments.append(segment)
        self.clock.begin_file()
        try:
            with path.open("rb") as file:
                for item in records(file, segment.size, self._channel):
                    if type(item) is tuple:
                        segment.count(item[1])
                        if item[0].decode is not None:  # other programs may have added channels
                            yield item
                    elif isinstance(item, DamagedBytes):
                        recording = segment.recording and item.at_end
                        reason = "the file is being recorded" if recording else item.reason
                        self.cuts.append(replace(item, path=path, reason=reason))
                    elif isinstance(item, Metadata):
                        self.metadata[item.name] = dict(item.metadata)
                        if item.name == ABOUT and item.metadata.get(CLOCK) == STEADY:
                            self.clock.trust()
                        if item.name == "robots":
                            self.robots.describe(item.metadata)
                    elif isinstance(item, Attachment):
                        self.attachments[item.name] = item.data
        except NotMcap as error:
            raise LogError(
                f"{path} is not an MCAP file: {error}. Logs of runs are; `brakeline import` reads CSV and other logs"
            ) from error

    @staticmethod
    def _channel(key: str, schema: str | None) -> LogChannel:
        topic = topic_of(key)
        kind = TYPES.get(schema or "")
        if schema is None and topic is not None:
            kind = topic.message
        names = {} if topic is None else names_of(topic, key)
        name = key.partition("/")[0] if topic is None else topic.name
        return LogChannel(name, key, None if kind is None else kind.FromString, names=names)


def find(paths: Paths) -> tuple[Path, ...]:
    """Return the files at `paths`: for a folder all its logs, for run.mcap also its segments run_0001.mcap ….

    A file counts once, however many paths and links lead to it: `runs/*` has the newest run also as `runs/latest`.

    Raises:
        LogError: a path has no log.
    """
    given = [paths] if isinstance(paths, str | os.PathLike) else list(paths)
    logs: dict[Path, Path] = {}
    for path in map(Path, given):
        if path.is_dir():
            files = list(path.glob("*.mcap"))
        elif path.is_file():
            name, number = number_of(path)
            later = path.parent.glob("*.mcap") if number == 0 else ()
            files = [path, *(other for other in later if number_of(other)[0] == name and other != path)]
        else:
            files = []
        if not files:
            raise LogError(f"no log at {path}: give an .mcap file or the folder of a run")
        for file in sorted(files, key=number_of):
            logs.setdefault(file.resolve(), file)
    runs: dict[tuple[Path, str], list[Path]] = {}
    for path in logs.values():
        runs.setdefault(_run_of(path), []).append(path)
    return tuple(path for segments in runs.values() for path in sorted(segments, key=number_of))


def refuse_to_overwrite_log(path: Path) -> None:
    """Check that a file that you will write is not a log, which would be lost. Raises LogError."""
    if not path.is_file():
        return
    with path.open("rb") as file:
        if file.read(len(MAGIC)) == MAGIC:
            raise LogError(f"{path} is a log, and is not overwritten: give the file to write another name")


def by_run(paths: Sequence[Path]) -> dict[str, tuple[Path, ...]]:
    """Group files by run, in the order of recording. A resumed or restarted run has several files.

    The label of a run is its folder, with the file's name unless that is `run`.
    """
    runs: dict[str, tuple[Path, ...]] = {}
    for (folder, name), files in groupby(paths, key=_run_of):
        place = folder.name
        label = place if name == "run" else f"{place}/{name}"
        namesakes = sum(other == label or other.startswith(f"{label} (") for other in runs)
        runs[f"{label} ({namesakes + 1})" if namesakes else label] = tuple(files)
    return runs


def count_by_key(path: Path) -> Counter[str]:
    """Return the number of messages in a file at each key. A file without a summary is read from front to back.

    Raises:
        LogError: the file is no log.
        OSError: it cannot be read.
    """
    with path.open("rb") as file, suppress(*BROKEN, KeyError):
        if has_whole_summary(file, path.stat().st_size):
            file.seek(0)
            summary = make_reader(file).get_summary()
            if summary is not None and summary.statistics is not None:
                counts: Counter[str] = Counter()
                for number, messages in summary.statistics.channel_message_counts.items():
                    counts[summary.channels[number].topic] += messages
                return counts
    return Counter(channel.key for channel, *_ in Log((path,)).rows())


def missing_segments(paths: Sequence[Path]) -> Iterator[MissingSegment]:
    """Yield the missing segments: gaps in the numbers of the segments at `paths`."""
    for (_, name), segments in groupby(paths, key=_run_of):
        files = list(segments)
        numbers = [-1, *sorted(number_of(path)[1] for path in files)]
        for before, after in pairwise(numbers if len(numbers) > 2 else ()):
            if (count := after - before - 1) > 0:
                first, last = (
                    files[0].with_name(name_of(f"{name}.mcap", number)) for number in (before + 1, after - 1)
                )
                yield MissingSegment(first, last, count)


def without_copies(paths: Sequence[Path]) -> tuple[Path, ...]:
    """Return the files, but not those of a run that is a copy of another run in its folder, such as a backup.

    A copy begins with the same message. Of a run and its copy, the one with more messages stays, or the older one.
    """
    runs = {run: tuple(files) for run, files in groupby(paths, key=_run_of)}
    folders = Counter(folder for folder, _ in runs)
    several = {run: files for run, files in runs.items() if folders[run[0]] > 1}
    firsts = {run: {first_message(path) for path in files} - {None} for run, files in several.items()}
    copies: set[Path] = set()
    for one, other in combinations(several, 2):
        same = one[0] == other[0] and firsts[one] and firsts[other]
        if same and (firsts[one] <= firsts[other] or firsts[other] <= firsts[one]):
            kept, left_out = sorted((several[one], several[other]), key=_most_and_oldest)
            if copies.isdisjoint((*kept, *left_out)):
                copies.update(left_out)
                log.warning("%s is a copy of %s, and is left out", left_out[0], kept[0])
    return tuple(path for path in paths if path not in copies)


def first_message(path: Path) -> tuple[str, int, int, bytes] | None:
    """Return the first message of a known type in a file, with its key and times; None if there is none."""
    with suppress(LogError, OSError):
        for channel, log_time, publish_time, payload in Log((path,)).rows():
            return channel.key, log_time, publish_time, payload
    return None


def _most_and_oldest(files: tuple[Path, ...]) -> tuple[int, float]:
    """Return what sorts a run before its copies: the number of messages of known topics, and the age."""
    counts = Counter[str]()
    for path in files:
        counts += count_by_key(path)
    return -sum(count for key, count in counts.items() if topic_of(key)), files[0].stat().st_mtime


def _run_of(path: Path) -> tuple[Path, str]:
    """Return the folder of a file's run, without links, and the run's name."""
    return path.parent.resolve(), number_of(path)[0]


def open_log(paths: Paths) -> Log:
    """Open the logs at `paths`, one or more files or folders, without copies of a run in its folder.

    Raises:
        LogError: a path has no log; or, while iterating, a file is not an MCAP file.
    """
    return Log(without_copies(find(paths)))


def read(paths: Paths) -> Iterator[Record]:
    """Yield the messages of the logs at `paths` in the order of recording. Raises as `open_log`."""
    yield from open_log(paths)

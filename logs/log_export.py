"""A log in other forms: its steps as CSV, and all of it with a picture of every step for Foxglove."""

from __future__ import annotations

import csv
import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any, TextIO

from google.protobuf.message import DecodeError

from brakeline.logs.foxglove import FoxgloveConverter
from brakeline.logs.minari_export import ExportError, nothing_of
from brakeline.logs.reader import TYPES, Log, Paths, Record, open_log
from brakeline.logs.segment import Entry, Segment, open_segment
from brakeline.messaging import brakeline_pb2 as pb
from brakeline.messaging.task import RobotWithTask

BATCH = 1000  # messages that are written at once


def columns(robot: RobotWithTask) -> dict[str, tuple[str, ...]]:
    """The names within each repeated field of a step, in their order. What is not here is not exported: `path`."""
    return {
        "observation": robot.task.observed,
        "proposed": robot.action,
        "action": robot.action,
        "next_observation": robot.task.observed,
        "state": robot.state,
        "true_state": robot.state,
    }


def to_csv(paths: Paths, robot: RobotWithTask, file: TextIO) -> int:
    """Write every step of a robot kind in the log as a line, in the order of receipt; returns how many, at least one.

    Columns: log_time [ns], header.time [s], header.source, header.run, header.sequence, the message's fields by their
    names; those that are vectors as `field.name [unit]`, the decision by its name.

    Raises:
        ExportError: there is no step of this robot; it says whose there are. NoLog, NotALog: there is no log.
    """
    vectors = columns(robot)
    plain = [f.name for f in pb.Step.DESCRIPTOR.fields if not f.is_repeated and f.message_type is None]
    header = ["time", "source", "run", "sequence"]
    table = csv.writer(file, lineterminator="\n")
    titles = [f"{name}.{part}" for name, parts in vectors.items() for part in parts]
    table.writerow(["log_time", *(f"header.{name}" for name in header), *plain, *titles])
    count, others = 0, set()
    for record in open_log(paths):
        if record.topic != "step":
            continue
        step = record.message
        if step.robot != robot.name:
            others.add(step.robot)
            continue
        values: list[Any] = [record.log_time, *(getattr(step.header, name) for name in header)]
        values += [pb.Kind.Name(step.decision) if name == "decision" else _plain(step, name) for name in plain]
        for name, parts in vectors.items():
            row = list(getattr(step, name))
            values += row if len(row) == len(parts) else [""] * len(parts)
        table.writerow(values)
        count += 1
    if not count:
        raise ExportError(nothing_of(robot, others))
    return count


def _plain(step: pb.Step, name: str) -> Any:
    value = getattr(step, name)
    return int(value) if isinstance(value, bool) else value


def to_foxglove(paths: Paths, out: Path, rate: float = math.inf) -> int:
    """Write a log's messages to `out`, with `rate` pictures a second and actor (infinite: one of every step), in place
    of those that it has; returns how many messages there are.

    Raises:
        ExportError: `out` is there already; NoLog, NotALog: there is no log; OSError: there is no space.
    """
    if out.exists():
        raise ExportError(f"{out} is there already")
    log = open_log(paths)
    pictures = FoxgloveConverter(rate, log.robots)
    segment: Segment | None = None
    count = 0
    batch: list[Entry] = []
    for stored, record in _stored(log):
        if segment is None:  # by now the metadata are known
            segment = open_segment(out, {k: v for k, v in log.metadata.items() if k != "brakeline"}, log.attachments)
        batch += [stored, *pictures.from_record(record)]
        if len(batch) >= BATCH:
            segment.save(batch)
            count, batch = count + len(batch), []
    if segment is None:
        raise ExportError("the log holds no message")
    segment.save(batch)
    segment.finish()
    return count + len(batch)


def _stored(log: Log) -> Iterator[tuple[Entry, Record]]:
    """The messages of a log, as they are stored, and decoded."""
    for series, log_time, publish_time, payload in log.rows():
        kind = TYPES[series.schema.name]
        try:
            message: Any = kind.FromString(payload)
        except DecodeError:
            log.malformed += 1
            continue
        entry = Entry(series.key, kind, payload, log_time, publish_time, message.header.sequence)
        yield entry, Record(series.topic, series.key, message, log_time, publish_time)

"""Export a log: steps as CSV, MAVLink frames as .tlog, or all messages with a Foxglove scene of every step."""

from __future__ import annotations

import csv
import math
import struct
from collections.abc import Iterator
from pathlib import Path
from typing import Any, BinaryIO, TextIO

from google.protobuf.message import DecodeError

from brakeline.errors import ExportError
from brakeline.logs.foxglove import FoxgloveConverter
from brakeline.logs.reader import TYPES, Log, Paths, Record, open_log
from brakeline.logs.segment import Entry, Segment, open_segment
from brakeline.messaging import brakeline_pb2 as pb
from brakeline.messaging.task import RobotWithTask

BATCH = 1000  # messages per write
TIME = struct.Struct(">Q")  # of a frame in a .tlog file: µs since the Unix epoch


def robot_steps(paths: Paths, robot: RobotWithTask) -> Iterator[Record]:
    """Yield the steps of a robot kind in the order of receipt.

    Raises:
        ExportError: the log has no step of this robot; the message lists the robots that it has.
        LogError: as `open_log`.
    """
    others, empty = set(), True
    for record in open_log(paths):
        if record.topic == "step" and record.message.robot == robot.name:
            empty = False
            yield record
        elif record.topic == "step":
            others.add(record.message.robot)
    if empty and others:
        names = ", ".join(sorted(others))
        advice = "give --robot NAME or the path of its description"
        raise ExportError(f"the log has no step of {robot.name}, but steps of {names}: {advice}")
    if empty:
        raise ExportError(f"the log has no step of {robot.name} or of any other robot")


def to_csv(paths: Paths, robot: RobotWithTask, file: TextIO) -> int:
    """Write each step of a robot kind as a line, and return the number of steps. Raises as `robot_steps`.

    Columns: log_time [ns], header.time [s], header.source, header.run, header.sequence, and the fields of the message
    but `path`; vectors as `field.name [unit]`, the decision by its name.
    """
    vectors = {
        **{"observation": robot.task.observed, "proposed": robot.action, "action": robot.action},
        **{"next_observation": robot.task.observed, "state": robot.state, "true_state": robot.state},
    }
    plain = [f.name for f in pb.Step.DESCRIPTOR.fields if not f.is_repeated and f.message_type is None]
    header = ["time", "source", "run", "sequence"]
    table = csv.writer(file, lineterminator="\n")
    titles = [f"{name}.{part}" for name, parts in vectors.items() for part in parts]
    table.writerow(["log_time", *(f"header.{name}" for name in header), *plain, *titles])
    count = 0
    for record in robot_steps(paths, robot):
        step = record.message
        values: list[Any] = [record.log_time, *(getattr(step.header, name) for name in header)]
        for name in plain:
            value = getattr(step, name)
            values.append(
                pb.Kind.Name(value) if name == "decision" else int(value) if isinstance(value, bool) else value
            )
        for name, parts in vectors.items():
            row = list(getattr(step, name))
            values += row if len(row) == len(parts) else [""] * len(parts)
        table.writerow(values)
        count += 1
    return count


def to_tlog(paths: Paths, file: BinaryIO) -> int:
    """Write all MAVLink frames, each after its time, for ground stations and pymavlink; return their number.

    Raises:
        ExportError: the log has no frame.
        NoLog, NotALog: as `open_log`.
    """
    frames = (frame for record in open_log(paths) if record.topic == "frames" for frame in record.message.frames)
    count = 0
    for frame in frames:
        file.write(TIME.pack(frame.wall_time // 1000) + frame.raw)
        count += 1
    if not count:
        raise ExportError("the log has no MAVLink frame: `brakeline train` records frames only with --mavlink")
    return count


def to_foxglove(paths: Paths, out: Path, rate: float = math.inf) -> int:
    """Write a log's messages to `out` with new Foxglove scenes, and return the number of messages.

    Args:
        rate: scenes per second and actor; infinity draws every step.

    Raises:
        ExportError: `out` exists, or the log has no message.
        LogError: as `open_log`.
        OSError: the disk is full or broken.
    """
    if out.exists():
        raise ExportError(f"{out} exists already")
    log = open_log(paths)
    converter = FoxgloveConverter(rate, log.robots)
    segment: Segment | None = None
    count = 0
    batch: list[Entry] = []
    for stored, record in _stored(log):
        if segment is None:  # the metadata come before the first message
            segment = open_segment(out, {k: v for k, v in log.metadata.items() if k != "brakeline"}, log.attachments)
        batch += [stored, *converter.from_record(record)]
        if len(batch) >= BATCH:
            segment.save(batch)
            count, batch = count + len(batch), []
    if segment is None:
        raise ExportError("the log holds no message")
    segment.save(batch)
    segment.finish()
    return count + len(batch)


def _stored(log: Log) -> Iterator[tuple[Entry, Record]]:
    """Yield the messages of a log, as stored and decoded."""
    for series, log_time, publish_time, payload in log.rows():
        kind = TYPES[series.schema.name]
        try:
            message: Any = kind.FromString(payload)
        except DecodeError:
            log.malformed += 1
            continue
        entry = Entry(series.key, kind, payload, log_time, publish_time, message.header.sequence)
        yield entry, Record(series.topic, series.key, message, log_time, publish_time)

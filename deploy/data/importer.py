"""Import recordings as a data set: choose a reader by the file's kind, then resample to the robot's period.

Brakeline's own logs are sampled at the period already, so that no resampling is needed.
"""

from __future__ import annotations

import importlib
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from mcap.exceptions import McapError
from mcap.reader import make_reader

from brakeline.deploy.data.log_options import PLAIN, LogOptions
from brakeline.deploy.data.resample import HOLD, ImportedData, ImportReport, resample
from brakeline.deploy.data.run_dataset import from_log
from brakeline.deploy.data.sources.source_table import Table
from brakeline.deploy.data.stamps import TIME, in_header_units, stamped
from brakeline.errors import NoSource
from brakeline.messaging.robot import Robot
from brakeline.safety.model.dataset import Dataset

ROS2 = "ros2_bag:read"
READERS = {
    ".csv": "csv_file:read",
    ".parquet": "column_files:read_parquet",
    ".db3": ROS2,
    ".bin": "ardupilot_log:read",
    ".tlog": "tlog_file:read",
    ".ulg": "px4_log:read",
}
KINDS = f"{', '.join(READERS)}, the folder of a ROS 2 bag, .mcap (a ROS 2 bag, or a log of a run)"
ALL_STEPS = 1_000_000  # of a Brakeline log


def tables_of(path: Path, options: LogOptions = PLAIN) -> list[Table]:
    """Read the tables of a source with the reader for its file name's ending.

    Args:
        path: the source.
        options: gives the column and the unit of the stamps, and the topics to prefer.

    Raises:
        NoSource: the file does not exist, its kind is not supported, or it is damaged.
    """
    if not path.exists():
        raise NoSource(f"{path}: this file or folder does not exist")
    place = ROS2 if is_bag(path) else READERS.get(path.suffix.lower())
    if place is None:
        raise NoSource(f"{path}: this kind of file is not supported. Brakeline reads {KINDS}.")
    module, _, name = place.partition(":")
    tables: list[Table] = getattr(importlib.import_module(f"brakeline.deploy.data.sources.{module}"), name)(path)
    column, unit = options.fields.get(TIME, ""), options.units.get(TIME, "")
    tables = [replace(t if t.name else stamped(in_header_units(t), column, unit), source=path.name) for t in tables]
    return options.ranked(tables)


def is_bag(path: Path) -> bool:
    """Return True for a ROS 2 bag: a folder with `metadata.yaml`, or an MCAP file with the profile `ros2`."""
    if path.is_dir():
        return (path / "metadata.yaml").is_file()
    if path.suffix != ".mcap":
        return False
    try:
        with path.open("rb") as file:
            return make_reader(file).get_header().profile == "ros2"
    except McapError:
        return False  # damaged: only Brakeline's own reader can recover a log


def own_log(path: Path) -> bool:
    """Return True for a log of a Brakeline run, a file or a folder."""
    return (path.suffix == ".mcap" or path.is_dir()) and path.exists() and not is_bag(path)


def import_sources(
    paths: Sequence[Path], robot: Robot, options: LogOptions = PLAIN, delay: float = 0.0, hold: float = HOLD
) -> ImportedData:
    """Import one or more recordings of one robot as one data set.

    Args:
        paths: the sources.
        robot: its description names the columns.
        options: where the columns are in the sources, and in which units.
        delay: time in s by which the stamps of the inputs are too early.
        hold: time in s for which an input is valid after its last message.

    Raises:
        BadData: a source cannot be used; the message names the source and the reason.
        LogError: a Brakeline log cannot be read.
    """
    parts = [_import_one(path, robot, options, delay, hold) for path in paths]
    reports = [part.report for part in parts]
    samples = {report.samples for report in reports}
    if len(samples) > 1:
        raise NoSource(
            f"the sources have different numbers of positions per period ({samples}): import them one by one"
        )
    data = Dataset(
        robot,
        tuple(t for part in parts for t in part.data.trajectories),
        {"origin": "import", "sources": ", ".join(path.name for path in paths)},
        max(part.data.chord_deviation for part in parts),
    )
    report = replace(
        reports[0],
        periods=data.periods,
        trajectories=len(data.trajectories),
        chord_deviation=data.chord_deviation,
        delays={name: seconds for report in reports for name, seconds in report.delays.items()},
        uneven=sum(report.uneven * report.periods for report in reports) / data.periods,
        notes=tuple(
            note if len(paths) == 1 or path.name in note else f"{path.name}: {note}"
            for path, report in zip(paths, reports, strict=True)
            for note in report.notes
        ),
    )
    return ImportedData(data, report)


def _import_one(path: Path, robot: Robot, options: LogOptions, delay: float, hold: float) -> ImportedData:
    if own_log(path):
        data, note = from_log(path, robot, ALL_STEPS)
        samples = data.trajectories[0].paths.shape[1]
        return ImportedData(data, ImportReport(data.periods, len(data.trajectories), samples, 0.0, {}, 0.0, (note,)))
    try:
        return resample(tables_of(path, options), robot, options, delay, hold)
    except NoSource as error:
        text = str(error)
        raise NoSource(text if text.startswith(str(path)) else f"{path}: {text}") from error

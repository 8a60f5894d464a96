"""Import recordings as a data set: choose a reader by the file's kind, then resample to the robot's period.

Brakeline's own logs have one sample in each period, so the import does not resample them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from brakeline.deploy.data.log_options import PLAIN, LogOptions
from brakeline.deploy.data.message_columns import fields_of, with_message_fields
from brakeline.deploy.data.resample import HOLD, ImportedData, ImportReport, resample
from brakeline.deploy.data.run_dataset import from_log
from brakeline.deploy.data.sources.isolated_reader import read_isolated
from brakeline.deploy.data.sources.source_table import Table
from brakeline.deploy.data.stamps import TIME, in_header_units, stamped
from brakeline.errors import NoSource
from brakeline.logs.mcap_container import is_ros
from brakeline.messaging.acceleration_age import about_age, acceleration_age_in
from brakeline.messaging.robot import Robot
from brakeline.safety.model.dataset import Dataset
from brakeline.safety.model.repeated_driving import repeated_driving

BAG_ENDINGS = (".bag", ".bag.active", ".db3", ".db3.zstd", ".mcap.zstd")  # and .mcap, unless it is a log of a run
BAG, PARQUET, JSON, OWN = "ros_bag:read", "parquet_files:read", "json_lines:read", "a log of a run"
READERS = {
    ".csv": "csv_file:read",
    ".parquet": PARQUET,
    ".jsonl": JSON,
    ".ndjson": JSON,
    ".json": JSON,
    ".bag": BAG,
    ".db3": BAG,
    ".bin": "ardupilot_log:read",
    ".log": "ardupilot_log:read",
    ".tlog": "tlog_file:read",
    ".ulg": "px4_log:read",
}
KINDS = f"{', '.join(READERS)}, .mcap (a bag, or a log of a run), and folders of bags, of Parquet files and of runs"
MOST_NAMES = 3  # of sources before a note
MOST_STEPS = 1_000_000  # of a log of a run; an import takes the last ones


def tables_of(path: Path, options: LogOptions = PLAIN) -> list[Table]:
    """Read the tables of a foreign log, in a process of its own.

    Args:
        options: gives the column and the unit of the stamps, the topics to prefer, and the limits.

    Raises:
        NoSource: the file does not exist, its kind is not supported, or it is damaged.
    """
    reader = reader_of(path)
    if reader == OWN:
        raise NoSource(f"{path} is a log of a run, which has no tables: give a log of another program")
    return with_time(read_isolated(reader, path, options.limits), path, options)


def with_time(tables: list[Table], path: Path, options: LogOptions) -> list[Table]:
    """Return tables with their time, their source and the ranks that the user chose. Raises NoSource."""
    column, unit = options.fields.get(TIME, ""), options.units.get(TIME, "")
    given = [options.fields.get(name, name) for name in options.units]

    def timed(table: Table) -> Table:
        if table.name:  # a topic or a type of messages: the reader has set its time
            return table
        named = [*given, *fields_of(given, table)]
        return with_message_fields(stamped(in_header_units(table, named), column, unit))

    return options.ranked([replace(timed(table), source=path.name) for table in tables])


def reader_of(path: Path) -> str:
    """Return the reader of a source, MODULE:FUNCTION in `sources`, or `OWN` for a log of a Brakeline run.

    Raises:
        NoSource: the file does not exist, or its kind is not supported.
    """
    if not path.exists():
        raise NoSource(f"{path}: this file or folder does not exist")
    if path.is_dir():
        names = [file.name.lower() for file in path.iterdir()]
        if any(name == "metadata.yaml" or name.endswith(BAG_ENDINGS) for name in names):
            return BAG
        if any(path.rglob("*.parquet")):
            return PARQUET
        logs = list(path.glob("*.mcap"))
        return BAG if logs and is_ros(logs[0]) else OWN
    if not path.is_file():
        raise NoSource(f"{path} is neither a file nor a folder")
    name = path.name.lower()
    if name.endswith(".mcap"):
        return BAG if is_ros(path) else OWN
    if name.endswith(BAG_ENDINGS):
        return BAG
    reader = READERS.get(path.suffix.lower())
    if reader is None:
        raise NoSource(f"{path}: this kind of file is not supported. Brakeline reads {KINDS}.")
    return reader


def own_log(path: Path) -> bool:
    """Return True for a log of a Brakeline run, a file or a folder."""
    return path.exists() and reader_of(path) == OWN


def import_sources(
    paths: Sequence[Path], robot: Robot, options: LogOptions = PLAIN, delay: float = 0.0, hold: float = HOLD
) -> ImportedData:
    """Import one or more recordings of one robot as one data set.

    Args:
        options: where the columns are in the sources, and in which units.
        delay: time in s by which the stamps of the inputs are too early.
        hold: time in s for which an input is valid after its last message.

    Raises:
        BadData: there is no source, or one cannot be used; the message names the source and the reason. Or the options
            do nothing for logs of runs.
        LogError: a Brakeline log cannot be read.
    """
    if not paths:
        raise NoSource("there is no log to import: name one or more files or folders")
    if all(map(own_log, paths)):
        _refuse_options(options, delay, hold)
    parts = [_import_one(path, robot, options, delay, hold) for path in paths]
    reports = [part.report for part in parts]
    samples = {report.samples for report in reports}
    if len(samples) > 1:
        raise NoSource(
            f"the sources have different numbers of positions in a period ({', '.join(map(str, sorted(samples)))}): "
            "import them one by one"
        )
    data = Dataset(
        robot,
        tuple(t for part in parts for t in part.data.trajectories),
        {"origin": "import", "sources": ", ".join(path.name for path in paths)}
        | about_age(acceleration_age_in(part.data.about) for part in parts),
        max(part.data.chord_deviation for part in parts),
    )
    _refuse_copies(paths, parts)
    report = replace(
        reports[0],
        periods=data.periods,
        trajectories=len(data.trajectories),
        chord_deviation=data.chord_deviation,
        delays={name: seconds for report in reports for name, seconds in report.delays.items()},
        uneven=sum(report.uneven * report.periods for report in reports) / data.periods,
        notes=_notes_by_source(paths, reports),
    )
    return ImportedData(data, report)


def _notes_by_source(paths: Sequence[Path], reports: Sequence[ImportReport]) -> tuple[str, ...]:
    """Return each note once. If there are several sources, it begins with the names of those that it is about."""
    names: dict[str, list[str]] = {}
    for path, report in zip(paths, reports, strict=True):
        for note in dict.fromkeys(report.notes):
            names.setdefault(note, []).append(path.name)
    return tuple(_after_names(note, of_note, len(paths)) for note, of_note in names.items())


def _after_names(note: str, names: list[str], sources: int) -> str:
    if sources == 1 or names[0] in note:
        return note
    if len(names) == sources:
        return f"all files: {note}"
    more = f" and {len(names) - MOST_NAMES} more" if len(names) > MOST_NAMES else ""
    return f"{', '.join(names[:MOST_NAMES])}{more}: {note}"


def _refuse_options(options: LogOptions, delay: float, hold: float) -> None:
    """Raise NoSource if options are given that logs of runs ignore: they have the robot's own states and inputs."""
    given = {"--map": options.fields, "--unit": options.units, "--topics": options.topics, "--delay": delay}
    if ignored := [name for name, value in (given | {"--hold": hold != HOLD}).items() if value]:
        raise NoSource(
            f"a log of a run has the coordinates and inputs of the robot, in each of its periods, so that "
            f"{', '.join(ignored)} would do nothing: leave that out"
        )


def _refuse_copies(paths: Sequence[Path], parts: Sequence[ImportedData]) -> None:
    """Raise NoSource if two sources hold the same driving."""
    if len(parts) < 2:
        return
    owners = [path for path, part in zip(paths, parts, strict=True) for _ in part.data.trajectories]
    twice = repeated_driving(parts[0].data.robot, [t for part in parts for t in part.data.trajectories])
    if twice is not None:
        raise NoSource(
            f"{owners[twice.first]} and {owners[twice.second]} hold the same driving, {twice.seconds:.0f} s in all: a "
            "copy is no evidence. Give each recording once"
        )


def _import_one(path: Path, robot: Robot, options: LogOptions, delay: float, hold: float) -> ImportedData:
    if own_log(path):
        data, note = from_log(path, robot, MOST_STEPS)
        samples = data.trajectories[0].paths.shape[1]
        return ImportedData(data, ImportReport(data.periods, len(data.trajectories), samples, 0.0, {}, 0.0, (note,)))
    try:
        return resample(tables_of(path, options), robot, options, delay, hold)
    except NoSource as error:
        text = str(error)
        raise NoSource(text if text.startswith(str(path)) else f"{path}: {text}") from error

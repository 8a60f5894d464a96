"""Read Parquet files and folders of them: their numeric columns, in which `stamps.stamped` finds the time."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pyarrow as arrow
import pyarrow.parquet as parquet

from brakeline.deploy.data.sources.source_table import Array, Table, natural_order
from brakeline.errors import NoSource

ENDING = ".parquet"


def read(path: Path) -> list[Table]:
    """Read a Parquet file, or the files of a folder one after the other, without their columns of text.

    A part NAME=VALUE of a path below the folder is a column too. Damaged files of a folder are left out.

    Raises:
        NoSource: no file is a Parquet file.
    """
    parts: list[dict[str, Array]] = []
    notes: list[str] = []
    for file in files_of(path):
        try:
            parts.append(_columns(file) | _partition(file.relative_to(path), parquet.read_metadata(file).num_rows))
        except (arrow.ArrowException, OSError) as error:
            notes.append(f"{file} is damaged, or not a Parquet file: {error}")
    if not parts:
        raise NoSource("; ".join(notes) or f"{path}: the folder contains no Parquet file")
    rows = [len(next(iter(part.values()), ())) for part in parts]
    columns = {
        name: np.concatenate([part.get(name, np.full(count, np.nan)) for part, count in zip(parts, rows, strict=True)])
        for name in dict.fromkeys(name for part in parts for name in part)
    }
    return [Table("", np.zeros(0), columns, notes=tuple(notes))]


def files_of(path: Path) -> list[Path]:
    """Return the Parquet files of a path, part-2 before part-10."""
    if path.is_file():
        return [path]
    files = [file for file in path.rglob(f"*{ENDING}") if file.is_file() and not file.name.startswith(("_", "."))]
    return sorted(files, key=natural_order)


def _columns(file: Path) -> dict[str, Array]:
    # One thread: a limited process has no memory for the stacks of many.
    table = parquet.ParquetFile(file).read(use_threads=False)
    while any(arrow.types.is_struct(kind) for kind in table.schema.types):
        table = table.flatten()
    return dict(_numbers(table))


def _numbers(table: arrow.Table) -> Iterator[tuple[str, Array]]:
    """Yield the names and values of the numeric columns; moments and durations in s."""
    for name, given in zip(table.column_names, table.columns, strict=True):
        kind, column, scale = given.type, given, 1.0
        if arrow.types.is_timestamp(kind) or arrow.types.is_date(kind):
            column, scale = given.cast(arrow.timestamp("ns")).cast(arrow.int64()), 1e-9
        elif arrow.types.is_duration(kind):
            column, scale = given.cast(arrow.duration("ns")).cast(arrow.int64()), 1e-9
        elif not (
            arrow.types.is_integer(kind)
            or arrow.types.is_floating(kind)
            or arrow.types.is_boolean(kind)
            or arrow.types.is_decimal(kind)
        ):
            continue
        values = np.asarray(column.cast(arrow.float64(), safe=False).to_numpy(zero_copy_only=False), float)
        yield name, scale * values


def _partition(place: Path, rows: int) -> dict[str, Array]:
    """Return the columns that the names of folders give: run=3 gives `run`."""
    pairs = [part.partition("=") for part in place.parts[:-1]]
    numbers = {name: value for name, equals, value in pairs if equals and re.fullmatch(r"-?\d+(\.\d+)?", value)}
    return {name: np.full(rows, float(value)) for name, value in numbers.items()}

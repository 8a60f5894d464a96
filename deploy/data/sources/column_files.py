"""Read CSV and Parquet files: `time` in s, a column per coordinate and input, and optionally `run`."""

from __future__ import annotations

import csv
from pathlib import Path

import numpy as np
import pyarrow as arrow
import pyarrow.parquet as parquet

from brakeline.deploy.data.sources.source_table import Table
from brakeline.errors import NoSource

TIME, RUN = "time", "run"


def read_csv(path: Path) -> list[Table]:
    """Read a CSV file; an empty cell is a missing value. Raises NoSource with the line of a malformed cell."""
    with path.open(newline="", encoding="utf-8-sig") as file:
        rows = csv.reader(file)
        names = [name.strip() for name in next(rows, [])]
        values: list[list[float]] = []
        for row in rows:
            if not row:
                continue
            if len(row) != len(names):
                raise NoSource(
                    f"{path}, line {rows.line_num}: {len(row)} cells, but the first line has {len(names)} names"
                )
            try:
                values.append([float(cell) if cell.strip() else np.nan for cell in row])
            except ValueError as error:
                raise NoSource(f"{path}, line {rows.line_num}: {error}") from error
    columns = np.array(values, float).reshape(-1, len(names)).T
    return [_table(path, dict(zip(names, columns, strict=True)), len(names))]


def read_parquet(path: Path) -> list[Table]:
    """Read a Parquet file without its non-numeric columns. Raises NoSource if it is not a Parquet file."""
    try:
        read = parquet.read_table(path)
    except arrow.ArrowException as error:
        raise NoSource(f"{path}: {error}") from error
    columns = {
        name: np.asarray(read[name].cast(arrow.float64()).to_numpy(zero_copy_only=False), float)
        for name in read.column_names
        if arrow.types.is_integer(read[name].type) or arrow.types.is_floating(read[name].type)
    }
    return [_table(path, columns, len(columns))]


def _table(path: Path, columns: dict[str, np.ndarray], count: int) -> Table:
    if len(columns) != count:
        raise NoSource(f"{path}: two columns have the same name")
    time = columns.pop(TIME, None)
    if time is None or not len(time):
        raise NoSource(
            f"{path}: the file needs a column `{TIME}` in s with at least one row; the columns are: "
            f"{', '.join(columns) or 'none'}"
        )
    run = columns.pop(RUN, np.zeros(len(time)))
    if not np.isfinite(run).all():
        raise NoSource(f"{path}: a row without a number in `{RUN}`")
    # Only the identity of a run matters: number the runs.
    starts = np.unique(run, return_inverse=True)[1].astype(np.intp)
    return Table("", time - np.nanmin(time), columns, starts)

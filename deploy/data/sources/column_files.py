"""Tables in files: CSV, Parquet. `time` [s], a column for each coordinate and input by its name, and maybe `run`."""

from __future__ import annotations

import csv
from pathlib import Path

import numpy as np
import pyarrow as arrow
import pyarrow.parquet as parquet

from brakeline.deploy.data.sources.source_table import NoSource, Table

TIME, RUN = "time", "run"


def read_csv(path: Path) -> list[Table]:
    """Raises NoSource, with line and column, for what is no number; an empty cell is no value."""
    with path.open(newline="", encoding="utf-8-sig") as file:
        rows = csv.reader(file)
        names = [name.strip() for name in next(rows, [])]
        values: list[list[float]] = []
        for row in rows:
            if not row:
                continue
            if len(row) != len(names):
                raise NoSource(f"{path}, line {rows.line_num}: {len(row)} cells, the first line names {len(names)}")
            try:
                values.append([float(cell) if cell.strip() else np.nan for cell in row])
            except ValueError as error:
                raise NoSource(f"{path}, line {rows.line_num}: {error}") from error
    columns = np.array(values, float).reshape(-1, len(names)).T
    return [_table(path, dict(zip(names, columns, strict=True)), len(names))]


def read_parquet(path: Path) -> list[Table]:
    """Raises NoSource for a file that is none; columns that hold no numbers are passed over."""
    try:
        read = parquet.read_table(path)
    except arrow.ArrowException as error:
        raise NoSource(f"{path}: {error}") from error
    kept = {
        name: np.asarray(read[name].cast(arrow.float64()).to_numpy(zero_copy_only=False), float)
        for name in read.column_names
        if arrow.types.is_integer(read[name].type) or arrow.types.is_floating(read[name].type)
    }
    return [_table(path, kept, len(kept))]


def _table(path: Path, columns: dict[str, np.ndarray], count: int) -> Table:
    if len(columns) != count:
        raise NoSource(f"{path}: two columns have the same name")
    time = columns.pop(TIME, None)
    if time is None or not len(time):
        raise NoSource(f"{path}: no column `{TIME}` [s] with rows below it; there are: {', '.join(columns) or 'none'}")
    run = columns.pop(RUN, np.zeros(len(time)))
    if not np.isfinite(run).all():
        raise NoSource(f"{path}: a row without a number in `{RUN}`")
    # Numbered as they come: a name of a run is only a name.
    starts = np.unique(run, return_inverse=True)[1].astype(np.intp)
    return Table("", time - np.nanmin(time), columns, starts)

"""Read Parquet files: their numeric columns, in which `stamps.stamped` finds the time."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pyarrow as arrow
import pyarrow.parquet as parquet

from brakeline.deploy.data.sources.source_table import Table
from brakeline.errors import NoSource


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
    return [Table("", np.zeros(0), columns)]

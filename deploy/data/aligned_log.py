"""Align the columns of a log: one row of positions, states and inputs for each time stamp of the positions."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from brakeline.deploy.data.sources.source_table import Array, Table
from brakeline.errors import NoSource

Indices = NDArray[np.intp]

BETWEEN_RUNS = 1e6  # s: longer than any span
FEWEST_ROWS = 20  # shorter runs are left out


@dataclass
class AlignedLog:
    """The rows of all runs of a log, one run after the other, and the roles of the columns.

    time (T,) in s, with a gap of `BETWEEN_RUNS` between two runs; columns: (T,) each.
    """

    time: Array
    columns: dict[str, Array]
    positions: list[str]  # names of the position columns
    inputs: list[str]
    heading: str = ""
    units: dict[str, str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        """Unwrap the heading, and find the sampling time and the period: the median time between input changes."""
        self.step = self.period = float(np.median(np.diff(self.time)))
        if self.inputs:
            changed = np.any([np.diff(self.columns[name]) != 0.0 for name in self.inputs], axis=0)
            if np.count_nonzero(changed) > 1:
                self.period = max(float(np.median(np.diff(self.time[1:][changed]))), self.step)
        self.set_heading(self.heading)

    def set_heading(self, name: str) -> None:
        """Take a column as the heading, and unwrap it."""
        self.heading = name
        if name:
            self.columns[name] = np.unwrap(self.columns[name])

    def runs(self) -> list[Indices]:
        """Return the row indices of each run."""
        rows = np.arange(len(self.time))
        return np.split(rows, np.flatnonzero(np.diff(self.time) >= BETWEEN_RUNS) + 1)

    def spans(self, seconds: float) -> tuple[Indices, Indices]:
        """Return the row indices i and j of all spans of about `seconds` without a missing row."""
        return self.rows_apart(max(round(seconds / self.step), 1))

    def rows_apart(self, n: int) -> tuple[Indices, Indices]:
        """Return the row indices i and i + n of all pairs without a missing row between them."""
        i = np.arange(max(len(self.time) - n, 0))
        i = i[self.time[i + n] - self.time[i] <= 1.5 * n * self.step]
        return i, i + n

    def change(self, name: str, i: Indices, j: Indices) -> Array:
        """Return the change of a column from rows i to rows j."""
        return self.columns[name][j] - self.columns[name][i]


def align(
    fields: dict[str, tuple[Table, str]],
    positions: list[str],
    inputs: list[str],
    units: dict[str, str],
    heading: str = "",
) -> AlignedLog:
    """Resample all fields to the time stamps of the first one: states linearly, inputs held.

    Raises:
        NoSource: too few rows have values in all columns.
    """
    first = next(iter(fields.values()))[0]
    times: list[Array] = []
    rows: dict[str, list[Array]] = {name: [] for name in fields}
    for run in np.unique(first.run) if len(first.run) else [0]:
        series = {name: table.series(column, int(run)) for name, (table, column) in fields.items()}
        if any(len(time) < 2 for time, _ in series.values()):
            continue
        begin, end = max(t[0] for t, _ in series.values()), min(t[-1] for t, _ in series.values())
        clock = next(iter(series.values()))[0]
        clock = clock[(clock >= begin) & (clock <= end)]
        if len(clock) < FEWEST_ROWS:
            continue
        for name, (time, values) in series.items():
            held = name in inputs
            rows[name].append(
                values[np.searchsorted(time, clock + 1e-9, "right") - 1] if held else np.interp(clock, time, values)
            )
        times.append(clock - clock[0] + (times[-1][-1] + BETWEEN_RUNS if times else 0.0))
    if not times:
        raise NoSource(f"fewer than {FEWEST_ROWS} rows have values in all columns")
    columns = {name: np.concatenate(parts) for name, parts in rows.items()}
    return AlignedLog(np.concatenate(times), columns, positions, inputs, heading, units)

"""Align the columns of a log: one row of positions, states and inputs for each time stamp of the positions."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from brakeline.deploy.data.beat import Beat, find_beat
from brakeline.deploy.data.sources.quantity_names import Places
from brakeline.deploy.data.sources.source_table import Array
from brakeline.errors import NoSource

Indices = NDArray[np.intp]

BETWEEN_RUNS = 1e6  # s: longer than any span
FEWEST_ROWS = 20  # shorter runs are left out


@dataclass
class AlignedLog:
    """The rows of all runs of a log, one run after the other, and the roles of the columns.

    time (T,) in s, with a gap of `BETWEEN_RUNS` between two runs; columns: (T,) each; input_step: time in s between two
    messages of the inputs, if they have stamps of their own; changes (C,): times in s of the changes of any input.
    """

    time: Array
    columns: dict[str, Array]
    positions: list[str]  # names of the position columns
    inputs: list[str]
    heading: str = ""
    units: dict[str, str] = field(default_factory=dict)
    input_step: float = 0.0
    changes: Array = field(default_factory=lambda: np.zeros(0))

    def __post_init__(self) -> None:
        """Unwrap the heading, and find the sampling time. The period is at first the sampling time."""
        self.step = self.period = float(np.median(np.diff(self.time)))
        self.set_heading(self.heading)

    def beat(self) -> Beat | None:
        """Return the beat of the inputs; None if they hardly change, or at any time."""
        between = np.diff(self.changes)
        return find_beat(between[between < BETWEEN_RUNS / 2.0], self.input_step or self.step)

    def set_heading(self, name: str) -> None:
        """Take a column as the heading, and unwrap it."""
        self.heading = name
        if name:
            self.columns[name] = np.unwrap(self.columns[name])

    def runs(self) -> list[Indices]:
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

    def input_spans(self) -> tuple[Indices, Indices]:
        """Return the row indices of all pairs between which an input changes as much as in one period.

        If the period is the beat, it changes once, which one row shows. With uneven stamps, the rows of a period may
        hold two changes.
        """
        beat = self.beat() if self.step < 0.75 * self.period else None
        once = beat is not None and abs(self.period / beat.seconds - 1.0) < 1e-6
        return self.rows_apart(1) if once else self.spans(self.period)

    def change(self, name: str, i: Indices, j: Indices) -> Array:
        """Return the change of a column from rows i to rows j."""
        return self.columns[name][j] - self.columns[name][i]


def align(
    fields: Places,
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
    changes: list[Array] = []
    rows: dict[str, list[Array]] = {name: [] for name in fields}
    for run in np.unique(first.run) if len(first.run) else [0]:
        series = {name: table.series(column, int(run)) for name, (table, column) in fields.items()}
        if any(len(time) < 2 for time, _ in series.values()):
            continue
        begin, end = max(t[0] for t, _ in series.values()), min(t[-1] for t, _ in series.values())
        whole = next(iter(series.values()))[0]
        for clock in _pieces(whole[(whole >= begin) & (whole <= end)]):
            for name, (time, values) in series.items():
                if name in inputs:
                    rows[name].append(values[np.searchsorted(time, clock + 1e-9, "right") - 1])
                else:
                    rows[name].append(np.interp(clock, time, np.unwrap(values) if name == heading else values))
            start = times[-1][-1] + BETWEEN_RUNS if times else 0.0
            times.append(start + (clock - clock[0]))
            at = [time[1:][np.diff(values) != 0.0] for time, values in (series[name] for name in inputs)]
            moments = np.unique(np.concatenate([clock[:0], *at]))
            changes.append(start + (moments[(moments >= clock[0]) & (moments <= clock[-1])] - clock[0]))
    if not times:
        raise NoSource(f"fewer than {FEWEST_ROWS} rows have values in all columns")
    columns = {name: np.concatenate(parts) for name, parts in rows.items()}
    own = [fields[name][0].time for name in inputs if fields[name][0] is not first]
    input_step = min((float(np.median(np.diff(time))) for time in own if len(time) > 1), default=0.0)
    every = np.concatenate(changes)
    # Messages of one moment have stamps that differ a little.
    every = every[np.diff(every, prepend=-np.inf) > 0.5 * input_step]
    return AlignedLog(np.concatenate(times), columns, positions, inputs, heading, units, input_step, every)


def _pieces(clock: Array) -> list[Array]:
    """Return the parts of a run's stamps that are long enough, cut where a damaged stamp is as far away as another run.

    Such a stamp would make all later ones equal, because their differences are too small beside it.
    """
    clock = clock[np.diff(clock, prepend=-np.inf) > 0.0]
    parts = np.split(clock, np.flatnonzero(np.diff(clock) >= BETWEEN_RUNS) + 1)
    return [part for part in parts if len(part) >= FEWEST_ROWS]


def joined(logs: Sequence[AlignedLog]) -> AlignedLog:
    """Return several logs of one robot as one; a column that one of them lacks is left out."""
    first = logs[0]
    names = [name for name in first.columns if all(name in log.columns for log in logs)]
    times: list[Array] = []
    changes: list[Array] = []
    for log in logs:
        offset = (times[-1][-1] + BETWEEN_RUNS if times else 0.0) - log.time[0]
        times.append(log.time + offset)
        changes.append(log.changes + offset)
    return AlignedLog(
        np.concatenate(times),
        {name: np.concatenate([log.columns[name] for log in logs]) for name in names},
        [name for name in first.positions if name in names],
        [name for name in first.inputs if name in names],
        first.heading if first.heading in names else "",
        {name: unit for name, unit in first.units.items() if name in names},
        max(log.input_step for log in logs),
        np.concatenate(changes),
    )

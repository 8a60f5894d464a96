"""The result of every reader: tables with columns of numbers over time."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from brakeline.errors import NoSource

Array = NDArray[np.float64]
Series = tuple[Array, Array]  # time in s and values (T,)


@dataclass(frozen=True)
class Table:
    """One stream of a source: a file of columns (with an empty name), a topic, or a message type.

    time (T,) in s; columns: (T,) each, NaN for a missing value; run (T,): index of the recording of each row; notes:
    what the reader could not read, or did not use, in sentences; lines (T,): line of each row in a file of text; units:
    the SI unit of each column whose header names a unit. A reader of columns leaves `time` empty: `stamps.stamped`
    finds it among the columns.
    """

    name: str
    time: Array
    columns: dict[str, Array]
    run: NDArray[np.intp] = field(default_factory=lambda: np.zeros(0, np.intp))
    rank: int = 0  # among tables with the same quantity, the lowest is used
    notes: tuple[str, ...] = ()
    lines: NDArray[np.intp] | None = None
    source: str = ""  # name of the file
    units: dict[str, str] = field(default_factory=dict)

    def series(self, column: str, run: int) -> Series:
        """Return times and values of a column in one run, without missing values.

        Raises:
            NoSource: the time decreases.
        """
        values = self.columns[column]
        valid = np.isfinite(self.time) & np.isfinite(values)
        if len(self.run):
            valid &= self.run == run
        time, values = self.time[valid], values[valid]
        back = np.flatnonzero(np.diff(time) < 0.0)
        if len(back):
            raise NoSource(
                f"{self.name or 'the source'}: time goes back from {time[back[0]]:g} to {time[back[0] + 1]:g} s; "
                "separate recordings need a column `run`"
            )
        new = np.diff(time, prepend=-np.inf) > 0.0  # the first of several samples at the same time
        return time[new], values[new]


def natural_order(file: Path) -> list[tuple[int, str]]:
    """Return the key by which files are sorted, part-2 before part-10."""
    return [(len(part), part) for part in re.split(r"(\d+)", str(file))]


def folded(name: str) -> str:
    """Return the name of a column without case, spaces and signs."""
    return "".join(character for character in name.lower() if character.isalnum())


def notes_of(tables: Sequence[Table]) -> tuple[str, ...]:
    """Return the notes of all tables, each once."""
    return tuple(dict.fromkeys(note for table in tables for note in table.notes))

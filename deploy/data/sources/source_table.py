"""What every reader gives: columns of numbers over time."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from brakeline.safety.model.dataset import BadData

Array = NDArray[np.float64]


class NoSource(BadData):
    """It can't be read as data of a robot; the message says why, and what would do."""


@dataclass(frozen=True)
class Table:
    """One stream of a source: a file of columns (its name is empty), a topic, a kind of message.

    time (T,) [s]; columns: each (T,), NaN where a row has no value; run (T,): which recording a row is of.
    """

    name: str
    time: Array
    columns: dict[str, Array]
    run: NDArray[np.intp] = field(default_factory=lambda: np.zeros(0, np.intp))
    rank: int = 0  # of tables with the same quantity, the lowest is taken

    def series(self, column: str, run: int) -> tuple[Array, Array]:
        """Times and values of one column in one run, without the rows that have none.

        Raises:
            NoSource: its time goes backwards.
        """
        values = self.columns[column]
        kept = np.isfinite(self.time) & np.isfinite(values)
        if len(self.run):
            kept &= self.run == run
        time, values = self.time[kept], values[kept]
        back = np.flatnonzero(np.diff(time) < 0.0)
        if len(back):
            raise NoSource(
                f"{self.name or 'the source'}: time goes back from {time[back[0]]:g} to {time[back[0] + 1]:g} s; "
                "recordings that begin anew need a column `run`"
            )
        new = np.diff(time, prepend=-np.inf) > 0.0  # of samples at the same time the first
        return time[new], values[new]


def table_of(name: str, nanoseconds: list[int], rows: list[dict[str, float]], since: int, rank: int = 0) -> Table:
    """A table of rows with names, stamped with nanoseconds; `since` is where time begins.

    Differences are made of whole numbers: a double can't hold nanoseconds since 1970.
    """
    order = np.argsort(np.asarray(nanoseconds, np.int64), kind="stable")
    time = (np.asarray(nanoseconds, np.int64) - since)[order] / 1e9
    names = dict.fromkeys(key for row in rows for key in row)
    columns = {key: np.array([rows[i].get(key, np.nan) for i in order], float) for key in names}
    return Table(name, time, columns, rank=rank)

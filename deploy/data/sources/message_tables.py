"""Collect the messages of a log in tables, and add their quantities (`quantity_names`)."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Iterable, Mapping
from typing import NamedTuple

import numpy as np

from brakeline.deploy.data.sources.source_table import Array, Table
from brakeline.errors import NoSource

Columns = dict[str, Array]
OTHER_CLOCK = 1_000_000_000  # ns: a larger median difference of stamps and receive times means two clocks


class MessageKind(NamedTuple):
    """A type of message: its rank among types with the same quantities, and how to compute them from its fields."""

    rank: int = 0
    quantities: Callable[[Columns], Columns] = lambda columns: {}


class MessageTables:
    """The messages of one source, as rows of numbers in named tables."""

    def __init__(self) -> None:
        self._kinds: dict[str, MessageKind] = {}
        self._stamps: dict[str, list[tuple[int, int]]] = defaultdict(list)
        self._rows: dict[str, list[Mapping[str, float]]] = defaultdict(list)

    def add(
        self,
        name: str,
        kind: MessageKind,
        fields: Iterable[tuple[str, object]],
        stamp: int,
        received: int | None = None,
    ) -> None:
        """Add a message to a table: its numbers, its stamp and its receive time (0: the stamp), in ns."""
        self._kinds[name] = kind
        self._stamps[name].append((stamp, received or stamp))
        self._rows[name].append({field: float(value) for field, value in fields if isinstance(value, int | float)})

    def tables(self, missing: str) -> list[Table]:
        """Return the tables; times begin at the first message. Raises NoSource(missing) if there is no message."""
        if not self._rows:
            raise NoSource(missing)
        times = {name: _times(np.array(stamps, np.int64)) for name, stamps in self._stamps.items()}
        since = min(int(time.min()) for time in times.values())
        return [self._table(name, time - since) for name, time in times.items()]

    def _table(self, name: str, nanoseconds: np.ndarray) -> Table:
        order = np.argsort(nanoseconds, kind="stable")
        rows = [self._rows[name][i] for i in order]
        names = dict.fromkeys(field for row in rows for field in row)
        columns = {field: np.array([row.get(field, np.nan) for row in rows]) for field in names}
        return Table(
            name, nanoseconds[order] / 1e9, with_quantities(columns, self._kinds[name]), rank=self._kinds[name].rank
        )


def with_quantities(columns: Columns, kind: MessageKind) -> Columns:
    """Return the columns and the quantities of which there is a value."""
    return columns | {name: values for name, values in kind.quantities(columns).items() if np.isfinite(values).any()}


def _times(stamps: np.ndarray) -> np.ndarray:
    """Return the times (T,) of (T, 2): stamps, or receive times if the clocks differ."""
    stamped, received = stamps.T
    return np.asarray(received if np.median(np.abs(stamped - received)) > OTHER_CLOCK else stamped)

"""Collect the messages of a log in tables, and add their quantities (`quantity_names`)."""

from __future__ import annotations

from array import array
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

from brakeline.deploy.data.sources.source_table import Array, Table
from brakeline.errors import NoSource

Columns = dict[str, Array]
OTHER_CLOCK = 1_000_000_000  # ns: a larger median difference of stamps and receive times means two clocks
LATEST_STAMP = 2**62  # ns since any epoch: a message with a later stamp, or one below 0, is damaged


class MessageKind(NamedTuple):
    """A type of message: its rank among types with the same quantities, and how to compute them from its fields."""

    rank: int = 0
    quantities: Callable[[Columns], Columns] = lambda columns: {}


@dataclass
class _Rows:
    """Consecutive messages with the same fields: their numbers, message by message."""

    names: tuple[str, ...]
    count: int = 0
    numbers: array[float] = field(default_factory=lambda: array("d"))


@dataclass
class _Stream:
    """The messages of one table."""

    kind: MessageKind
    stamps: array[int] = field(default_factory=lambda: array("q"))  # of each message: stamp and receive time, ns
    parts: list[_Rows] = field(default_factory=list)

    def columns(self) -> Columns:
        """Return a column (T,) for each field, NaN where a message does not have it."""
        columns: Columns = {}
        total, row = len(self.stamps) // 2, 0
        for part in self.parts:
            values = np.array(part.numbers).reshape(part.count, len(part.names))
            for i, name in enumerate(part.names):
                columns.setdefault(name, np.full(total, np.nan))[row : row + part.count] = values[:, i]
            row += part.count
        return columns


class MessageTables:
    """The messages of one source, as rows of numbers in named tables. `damage` says what could not be read."""

    def __init__(self, path: Path) -> None:
        self.path, self.damage = path, list[str]()
        self._streams: dict[str, _Stream] = {}
        self._misdated = 0

    def add(
        self,
        name: str,
        kind: MessageKind,
        fields: Iterable[tuple[str, object]],
        stamp: int,
        received: int | None = None,
    ) -> None:
        """Add a message to a table: its numbers, its stamp and its receive time (0: the stamp), in ns."""
        received = received or stamp
        if not (0 <= stamp < LATEST_STAMP and 0 <= received < LATEST_STAMP):
            self._misdated += 1
            return
        numbers = {field: float(value) for field, value in fields if isinstance(value, int | float)}
        stream = self._streams.setdefault(name, _Stream(kind))
        names = tuple(numbers)
        if not stream.parts or stream.parts[-1].names != names:
            stream.parts.append(_Rows(names))
        stream.parts[-1].count += 1
        stream.parts[-1].numbers.extend(numbers.values())
        stream.stamps.extend((stamp, received))

    @contextmanager
    def until_damaged(self) -> Iterator[None]:
        """Run a third-party parser. If it stops with an error, keep the messages before, and note the damage."""
        try:
            yield
        except (MemoryError, ModuleNotFoundError, NoSource):
            raise
        except Exception as error:  # parsers raise many types on damaged files
            count = sum(len(stream.stamps) // 2 for stream in self._streams.values())
            self.damage.append(f"damaged after {count} messages ({type(error).__name__}: {error}); the rest is lost")

    def tables(self, missing: str) -> list[Table]:
        """Return the tables; times begin at the first message.

        Raises:
            NoSource: there is no message; its text is the path, `missing` and the damage.
        """
        if self._misdated:
            self.damage.append(f"{self._misdated} messages with impossible time stamps are left out")
        if not self._streams:
            raise NoSource(f"{self.path}: {'; '.join((*self.damage, missing))}")
        times = {name: _times(np.array(one.stamps).reshape(-1, 2)) for name, one in self._streams.items()}
        since = min(int(time.min()) for time in times.values())
        tables = [self._table(name, time - since) for name, time in times.items()]
        notes = tuple(f"{self.path}: {text}" for text in self.damage)
        return [replace(tables[0], notes=tables[0].notes + notes), *tables[1:]]

    def _table(self, name: str, nanoseconds: np.ndarray) -> Table:
        stream = self._streams[name]
        order = np.argsort(nanoseconds, kind="stable")
        columns = {field: values[order] for field, values in stream.columns().items()}
        table = Table(name, nanoseconds[order] / 1e9, columns, rank=stream.kind.rank)
        return with_quantities(table, stream.kind, self.path)


def with_quantities(table: Table, kind: MessageKind, path: Path) -> Table:
    """Return the table with the quantities of which there is a value; a note says which fields are missing."""
    try:
        quantities = kind.quantities(table.columns)
    except (KeyError, ValueError) as error:
        return replace(table, notes=(*table.notes, f"{path}: {table.name} is not used: it lacks the field {error}"))
    seen = {name: values for name, values in quantities.items() if np.isfinite(values).any()}
    return replace(table, columns=table.columns | seen)


def _times(stamps: np.ndarray) -> np.ndarray:
    """Return the times (T,) of (T, 2): stamps, or receive times if the clocks differ."""
    stamped, received = stamps.T
    return np.asarray(received if np.median(np.abs(stamped - received)) > OTHER_CLOCK else stamped)

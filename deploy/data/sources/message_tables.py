"""Collect the messages of a log in tables, and add their quantities (`quantity_names`)."""

from __future__ import annotations

from array import array
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from brakeline.deploy.data.sources.source_table import Array, Table
from brakeline.deploy.data.stamps import OUT_OF_ORDER
from brakeline.errors import NoSource

Columns = dict[str, Array]
Indices = NDArray[np.int64]
OTHER_CLOCK = 1_000_000_000  # ns: a larger median difference of stamps and receive times means two clocks
BETWEEN_RUNS = 10_000_000_000  # ns
MOST_RESTARTS = 50  # of a clock: more are no restarts, but stamps of several clocks
NAMED = 3  # restarts that notes name
LATEST_STAMP = 2**62  # ns since any epoch: a message with a later stamp, or one below 0, is damaged


class MessageKind(NamedTuple):
    """A type of message: its rank among types with the same quantities, and how to compute them from its fields."""

    rank: int = 0
    quantities: Callable[[Columns], Columns] = lambda columns: {}


@dataclass
class _Stream:
    """The messages of one table."""

    kind: MessageKind
    stamps: array[int] = field(default_factory=lambda: array("q"))  # of each message: number, stamp, receive time [ns]
    columns: dict[str, array[float]] = field(default_factory=dict)  # of each field: NaN where a message lacks it


class MessageTables:
    """The messages of one source, as rows of numbers in named tables. `damage` says what could not be read."""

    def __init__(self, path: Path) -> None:
        self.path, self.damage = path, list[str]()
        self._streams: dict[str, _Stream] = {}
        self._misdated = self._count = 0

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
        for column in numbers:
            if column not in stream.columns:
                stream.columns[column] = array("d", [np.nan]) * (len(stream.stamps) // 3)
        for column, values in stream.columns.items():
            values.append(numbers.get(column, np.nan))
        stream.stamps.extend((self._count, stamp, received))
        self._count += 1

    @contextmanager
    def until_damaged(self) -> Iterator[None]:
        """Run a third-party parser. If it stops with an error, keep the messages before, and note the damage."""
        try:
            yield
        except (MemoryError, ModuleNotFoundError, NoSource):
            raise
        except Exception as error:  # parsers raise many types on damaged files
            what = f"{type(error).__name__}: {error}"
            self.damage.append(f"damaged after {self._count} messages ({what}); the rest is lost")

    def tables(self, missing: str) -> list[Table]:
        """Return the tables; times begin at the first message.

        Raises:
            NoSource: there is no message; its text is the path, `missing` and the damage.
        """
        if self._misdated:
            self.damage.append(f"{self._misdated} messages with impossible time stamps are left out")
        if not self._streams:
            raise NoSource(f"{self.path}: {'; '.join((*self.damage, missing))}")
        clocks = {name: _Clock.of(np.array(one.stamps).reshape(-1, 3)) for name, one in self._streams.items()}
        begins, text = _restarts(list(clocks.values()))
        self.damage += text
        clocks = dict(zip(clocks, _one_after_the_other(list(clocks.values()), begins), strict=True))
        since = min(int(clock.times.min()) for clock in clocks.values())
        tables = [self._table(name, clock, since) for name, clock in clocks.items()]
        notes = tuple(f"{self.path}: {text}" for text in self.damage)
        return [replace(tables[0], notes=tables[0].notes + notes), *tables[1:]]

    def _table(self, name: str, clock: _Clock, since: int) -> Table:
        stream, order = self._streams[name], np.argsort(clock.times, kind="stable")
        columns = {field: np.array(values)[order] for field, values in stream.columns.items()}
        time = (clock.times[order] - since) / 1e9
        table = Table(name, time, columns, clock.runs[order], rank=stream.kind.rank)
        return with_quantities(table, stream.kind, self.path)


def with_quantities(table: Table, kind: MessageKind, path: Path) -> Table:
    """Return the table with the quantities of which there is a value; a note says which fields are missing."""
    try:
        quantities = kind.quantities(table.columns)
    except (KeyError, ValueError) as error:
        return replace(table, notes=(*table.notes, f"{path}: {table.name} is not used: it lacks the field {error}"))
    seen = {name: values for name, values in quantities.items() if np.isfinite(values).any()}
    return replace(table, columns=table.columns | seen)


class _Clock(NamedTuple):
    """When the messages (T,) of a table came: their numbers in the log, times in ns, and runs of the clock."""

    numbers: Indices
    times: Indices
    runs: Indices

    @staticmethod
    def of(stamps: Indices) -> _Clock:
        """Return the clock of messages (T, 3): the receive times count if they are of another clock than the stamps."""
        numbers, stamped, received = stamps.T
        apart = np.median(np.abs(stamped - received)) > OTHER_CLOCK
        return _Clock(numbers, received if apart else stamped, np.zeros(len(numbers), np.intp))


def _restarts(clocks: Sequence[_Clock]) -> tuple[Indices, list[str]]:
    """Return the numbers of the messages with which the time begins again, and notes on them.

    A step back of one table is one of all tables: between the two messages, every table gets its next message.
    """
    back = OUT_OF_ORDER * 1e9
    steps = [
        (int(clock.numbers[i + 1]), int(clock.numbers[i]), int(clock.times[i] - clock.times[i + 1]))
        for clock in clocks
        for i in np.flatnonzero(np.diff(clock.times) < -back)
    ]
    begins, notes = list[int](), list[str]()
    for number, before, size in sorted(steps):
        if not begins or begins[-1] <= before:  # no other table's step is between the two messages
            begins.append(number)
            notes.append(f"the time steps back by {size / 1e9:.6g} s at message {number}: the recording is cut there")
    if len(begins) > MOST_RESTARTS:
        return np.zeros(0, np.int64), [
            f"the time steps back {len(begins)} times: the messages are sorted by their stamps"
        ]
    more = [f"{len(notes) - NAMED} more steps back of the time: cut there"] if len(notes) > NAMED else []
    return np.array(begins, np.int64), notes[:NAMED] + more


def _one_after_the_other(clocks: Sequence[_Clock], begins: Indices) -> list[_Clock]:
    """Return the clocks with their runs; each run is shifted, so that it begins after the end of the run before."""
    runs = [np.searchsorted(begins, clock.numbers, "right") for clock in clocks]
    shift, end = [0], 0
    for run in range(len(begins) + 1):
        times = np.concatenate([clock.times[of == run] for clock, of in zip(clocks, runs, strict=True)])
        if run:
            shift.append(end + BETWEEN_RUNS - int(times.min()))
        end = int(times.max()) + shift[-1]
    if end > LATEST_STAMP:  # a damaged stamp is decades late
        return list(clocks)
    return [_Clock(c.numbers, c.times + np.array(shift)[of], of) for c, of in zip(clocks, runs, strict=True)]

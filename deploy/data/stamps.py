"""Find the time stamps of a table of columns: their column, their unit, and where they step back."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from brakeline.deploy.data.sources.source_table import Array, Table, folded
from brakeline.deploy.data.unit_table import NAMES as UNIT_NAMES
from brakeline.deploy.data.unit_table import factor, si_of, split_header, unknown_unit
from brakeline.errors import NoSource

TIME, RUN = "time", "run"
# Other names of the time, in lower case, without signs and units; the first of them that a file has is taken.
NAMES = (
    *("time", "timestamp", "stamp", "t", "ts", "headerstamp", "fieldheaderstamp", "rosbagtimestamp", "timeboot"),
    *("datetime", "elapsedtime", "timeelapsed", "elapsed", "utime", "unixtime", "simtime", "gpstime", "epoch"),
    *("seconds", "secs", "sec", "headerstampsecs", "headerstampsec", "stampsecs", "stampsec", "date"),
)
SUFFIX = re.compile(
    r"(?<=.)[ _.]?(s|secs?|seconds|ms|msec|millis|us|usec|µs|micros|ns|nsec|nanos|nanoseconds)$", re.IGNORECASE
)
SECONDS = re.compile(r"secs?$", re.IGNORECASE)
FRACTIONS = ("nsecs", "nsec", "nanosecs", "nanosec", "nanoseconds")  # beside SECONDS
EPOCH = (6.3e8, 4.1e9)  # s since 1970, in 1990 and 2100
FACTORS = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}
UNITS_OF_TIME = "s, ms, us, ns, min or h"
STEPS = (5e-4, 1.0)  # s between two rows of a robot's log
SENSIBLE_STEPS = (1e-5, 60.0)  # s: others are refused
OUT_OF_ORDER = 1.0  # s: a smaller step back is a row out of order; a larger one begins another recording
NAMED = 3  # steps back that notes name


def stamped(table: Table, column: str = "", unit: str = "") -> Table:
    """Return a table of columns with its time in s from its first row, cut into runs where the stamps step back.

    Args:
        table: its columns contain the stamps.
        column: name of their column; found by its name if empty.
        unit: their unit; found if empty.

    Raises:
        NoSource: there is no such column, or its values are no plausible stamps.
    """
    columns = dict(table.columns)
    name = column or _time_column(columns)
    if name not in columns:
        missing = f"there is no column {column!r} (--map)" if column else "no column is known to hold time stamps"
        raise NoSource(
            f"{missing}: name it with --map {TIME}=COLUMN. The columns are: {', '.join(columns) or 'none'}"
            + "".join(f"\n{note}" for note in table.notes)
        )
    stamps, run = columns.pop(name), columns.pop(RUN, np.zeros(len(table.columns[name])))
    if (fraction := _fraction(name, columns)) is not None:
        stamps, unit = stamps + 1e-9 * columns.pop(fraction), unit or "s"
    valid = np.isfinite(stamps)
    if not valid.any():
        raise NoSource(f"column {name} holds no time stamp")
    if not np.isfinite(run).all():
        raise NoSource(f"a row has no number in `{RUN}`")
    runs = np.unique(run, return_inverse=True)[1].astype(np.intp)  # only the identity of a run matters
    steps = np.diff(stamps[valid])[np.diff(runs[valid]) == 0]
    if len(steps) and (steps < 0.0).all():
        raise NoSource(f"column {name}: the time runs backwards from row to row. Write the rows in the opposite order")
    steps = steps[steps > 0.0]
    if not len(steps) and np.count_nonzero(valid) > 1:
        raise NoSource(f"column {name}: the time stamps never increase; name another column with --map {TIME}=COLUMN")
    step, notes = float(np.median(steps)) if len(steps) else 0.0, [*table.notes]
    if not unit:
        unit, note = _unit(name, float(np.median(np.abs(stamps[valid]))), step)
        notes += [note] if note else []
    if (scale := factor(unit, "s")) is None:
        raise NoSource(f"--unit {TIME}={unit}: the unit of stamps is {UNITS_OF_TIME}")
    if len(steps) and not SENSIBLE_STEPS[0] <= step * scale <= SENSIBLE_STEPS[1]:
        raise NoSource(
            f"column {name}: in {unit}, the log would have a row every {step * scale:.3g} s, which is not plausible. "
            f"Give the unit of the stamps with --unit {TIME}=ms (or s, us, ns)."
        )
    time = (stamps - stamps[valid].min()) * scale
    whole = replace(table, time=time, columns=columns, run=runs, notes=tuple(notes))
    return _cut_at_steps_back(_rows(whole, np.flatnonzero(valid)))


def in_header_units(table: Table, given: Sequence[str] = ()) -> Table:
    """Return a table of columns `NAME [UNIT]` as columns NAME in SI units; the stamps stay as they are.

    given: columns of which the user names the unit, which counts, not that of the header. Their values stay.
    """
    chosen = {folded(split_header(name)[0]) for name in given}
    columns: dict[str, Array] = {}
    units: dict[str, str] = {}
    notes: list[str] = []
    for name, values in table.columns.items():
        plain, unit = split_header(name)
        scale = factor(unit) if unit else None
        as_it_is = plain in table.columns or plain in columns or _letters(plain) in NAMES
        if scale is None or as_it_is or factor(unit, "s") is not None:
            columns[name] = values
            continue
        if folded(plain) in chosen:
            columns[plain], units[plain] = values, si_of(unit)
            continue
        columns[plain], units[plain] = values * scale, si_of(unit)
        if scale != 1.0:
            notes.append(f"column {name}: converted from {unit} to SI")
    return replace(table, columns=columns, units=units, notes=(*table.notes, *notes))


def _cut_at_steps_back(table: Table) -> Table:
    """Return the table with a new run after each step back of its time, and with rows out of order sorted."""
    table = _rows(table, np.argsort(table.run, kind="stable"))
    time, same = table.time, np.diff(table.run) == 0
    back = np.flatnonzero((np.diff(time) < -OUT_OF_ORDER) & same) + 1
    notes = [
        f"{_place(table, int(i))}: the time goes back from {time[i - 1]:.6g} to {time[i]:.6g} s: "
        "the recording is cut there"
        for i in back[:NAMED]
    ]
    notes += [f"{len(back) - NAMED} more steps back of the time: cut there"] if len(back) > NAMED else []
    begins = np.concatenate([[False], ~same])
    begins[back] = True
    table = replace(table, run=np.cumsum(begins).astype(np.intp))
    order = np.lexsort((time, table.run))
    if moved := int(np.count_nonzero(np.diff(order) < 0)):
        notes.append(f"{moved} rows are out of order by less than {OUT_OF_ORDER:g} s: sorted by their stamps")
    return replace(_rows(table, order), notes=(*table.notes, *notes))


def _rows(table: Table, rows: NDArray[np.intp]) -> Table:
    columns = {name: values[rows] for name, values in table.columns.items()}
    lines = None if table.lines is None else table.lines[rows]
    return replace(table, time=table.time[rows], columns=columns, run=table.run[rows], lines=lines)


def _place(table: Table, row: int) -> str:
    return f"line {table.lines[row]}" if table.lines is not None else f"row {row + 1}"


def _time_column(columns: dict[str, Array]) -> str:
    """Return the column with the time: `time`, else the first of `NAMES`; empty if there is none."""
    if TIME in columns:
        return TIME
    plain = {name: _letters(SUFFIX.sub("", split_header(name)[0])) for name in columns}
    plain |= {name: _letters(name) for name in columns if plain[name] not in NAMES}
    return next((name for wanted in NAMES for name, short in plain.items() if short == wanted), "")


def _letters(name: str) -> str:
    """Return the letters of a name, in lower case."""
    return re.sub(r"[^a-z]", "", name.lower())


def _fraction(name: str, columns: dict[str, Array]) -> str | None:
    """Return the column with the nanoseconds of stamps in seconds and nanoseconds; None if there is no such column."""
    if not SECONDS.search(name):
        return None
    stem = SECONDS.sub("", name).lower()
    return next((other for other in columns if other.lower() in {f"{stem}{end}" for end in FRACTIONS}), None)


def _unit(name: str, size: float, step: float) -> tuple[str, str]:
    """Return the unit of stamps, and a note on it unless it is s, as documented.

    The header's unit counts first. The size of stamps since 1970 shows their unit. For others, it is the largest unit
    in which the step between two rows is plausible.

    Raises:
        NoSource: the header's unit is not known, or is no unit of time.
    """
    plain, declared = split_header(name)
    if not declared and (suffix := SUFFIX.search(plain)):
        word = suffix[1].lower()
        declared = {"millis": "ms", "micros": "us", "nanos": "ns", "nanoseconds": "ns"}.get(word, word)
        declared = UNIT_NAMES.get(declared, declared)
    since_1970 = [unit for unit, scale in FACTORS.items() if EPOCH[0] <= size * scale <= EPOCH[1]]
    plausible = [unit for unit, scale in FACTORS.items() if STEPS[0] <= step * scale <= STEPS[1]]
    unknown = "" if since_1970 else unknown_unit(name)
    if unknown == "-" or unknown.isdecimal():  # no unit, or the index of a field
        unknown = ""
    if declared and factor(declared, "s") is None:
        unknown = declared
    if unknown:
        raise NoSource(
            f"column {name}: {unknown!r} is no known unit of time; name one with --unit {TIME}=UNIT: {UNITS_OF_TIME}"
        )
    unit = next(iter((*([declared] if declared else []), *since_1970, *plausible)), "s")
    if name == TIME and unit == "s" and not since_1970:
        return unit, ""
    epoch = " since 1970" if unit in since_1970 else ""
    return (
        unit,
        f"column {name}: the time, in {unit}{epoch}, with a row every {step * (factor(unit, 's') or 1.0):.3g} s",
    )

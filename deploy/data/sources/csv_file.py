"""Read a CSV file in any of the usual dialects: find separator, decimal mark, header, comments and damaged lines.

The result has every numeric column; `deploy/data/stamps.py` finds the time among them.
"""

from __future__ import annotations

import csv as quoted
import io
import math
import re
from collections import Counter
from dataclasses import dataclass, field
from datetime import UTC, datetime, time
from pathlib import Path

import numpy as np
import pyarrow as arrow
from pyarrow import csv

from brakeline.deploy.data.sources.source_table import Array, Table
from brakeline.errors import NoSource

SEPARATORS = (";", "\t", "|", ",", " ")  # a comma may be a decimal mark, and a space may be within a name
EXCEL = re.compile(r"\s*\"?sep=.?\"?\s*", re.IGNORECASE)  # a first line that tells Excel the separator
COMMENT = re.compile(r"\s*(?:#|%|//)")
NUMBER = re.compile(r"\s*\"?[-+]?(?:\d+(?:[.,]\d*)?|[.,]\d+)(?:e[-+]?\d+)?\"?\s*", re.IGNORECASE)
SPACES = " '\u2019\u00a0\u202f"  # that some programs write between thousands
# Numbers with a mark or a space between thousands, by their decimal mark.
GROUPED = {
    decimal: re.compile(rf"[-+]?[1-9]\d{{0,2}}(?:[{other}{SPACES}]\d{{3}})+(?:{decimal}\d*)?")
    for decimal, other in ((",", "."), (".", ","))
}
MISSING = ("", "nan", "na", "n/a", "null", "none", "-")  # in any case: a cell without a value
DAMAGED = 0.01  # largest share of lines, or of a column's cells, that is left out
SAMPLE = 200  # lines that decide on the dialect
NAMED = 3  # lines that a message names


@dataclass
class _Dialect:
    """How a file is written, and its data lines with their numbers in the file."""

    separator: str
    decimal: str
    names: list[str]
    lines: list[str]
    numbers: list[int]
    notes: list[str] = field(default_factory=list)


def read(path: Path) -> list[Table]:
    """Read a CSV file; an empty cell is a missing value.

    Damaged lines and cells are left out, and notes name them, as long as they are few.

    Raises:
        NoSource: the file has no rows of numbers, or too many lines do not fit its header.
    """
    dialect = _dialect(path)
    skipped: list[int] = []

    def skip(row: csv.InvalidRow) -> str:
        skipped.append(row.number - 1)
        return "skip"

    data, places = "\n".join(dialect.lines).encode(), [str(i) for i in range(len(dialect.names))]
    try:
        table = csv.read_csv(
            io.BytesIO(data),
            # One block: pyarrow infers the type of a column from the first one.
            csv.ReadOptions(use_threads=False, block_size=len(data) + 1, column_names=places),
            csv.ParseOptions(delimiter=dialect.separator, invalid_row_handler=skip, ignore_empty_lines=False),
            csv.ConvertOptions(decimal_point=dialect.decimal, strings_can_be_null=True),
        )
    except arrow.ArrowException as error:
        raise NoSource(f"{path}: {error}") from error
    numbers = np.delete(np.array(dialect.numbers, np.intp), skipped)
    if not len(numbers) or len(skipped) > max(DAMAGED * len(dialect.lines), NAMED):
        first = skipped[0] if skipped else 0
        cells = dialect.lines[first].count(dialect.separator) + 1 if dialect.lines else 0
        raise NoSource(
            f"{path}, line {dialect.numbers[first] if dialect.lines else 1}: {cells} cells, but the header has "
            f"{len(dialect.names)} names ({len(skipped)} of {len(dialect.lines)} lines do not fit it)"
            + _decimal_commas(dialect, cells)
        )
    if skipped:
        where = _listed([dialect.numbers[i] for i in skipped])
        dialect.notes.append(f"{path.name}, {where}: not {len(dialect.names)} cells, as the header has: left out")
    columns: dict[str, Array] = {}
    for name, column in zip(dialect.names, table.columns, strict=True):
        values, note = _numbers(column, dialect.decimal, numbers)
        if values is not None:
            columns[name] = values
        if note:
            dialect.notes.append(f"{path.name}, column {name}, {note}")
    return [Table("", np.zeros(0), columns, notes=tuple(dialect.notes), lines=numbers)]


def _decimal_commas(dialect: _Dialect, cells: int) -> str:
    """Return what to do if commas separate cells and decimals both, so that lines have about twice the cells."""
    if dialect.separator != "," or not 1.5 * len(dialect.names) < cells <= 2 * len(dialect.names):
        return ""
    return ". If the numbers have decimal commas, write the file with semicolons between its cells, or decimal points"


def _dialect(path: Path) -> _Dialect:
    """Find out how a file is written."""
    text, whole = _text(path)
    lines = text.splitlines()
    for_excel = {1} if lines and EXCEL.fullmatch(lines[0]) else set()
    numbered = [(i, line) for i, line in enumerate(lines, 1) if line.strip() and i not in for_excel]
    comments = [(i, line) for i, line in numbered if COMMENT.match(line)]
    rows = [(i, line) for i, line in numbered if not COMMENT.match(line)]
    if not rows:
        raise NoSource(f"{path}: the file has no rows")
    sample = [line for _, line in rows[:SAMPLE]]
    separator = _separator(sample)
    notes: list[str] = []
    if separator == " ":
        rows = [(i, " ".join(line.split())) for i, line in rows]
        sample = [line for _, line in rows[:SAMPLE]]
    width = Counter(len(_cells(line, separator)) for line in sample[1:] or sample).most_common(1)[0][0]
    sample_cells = [cell for line in sample for cell in _cells(line, separator)]
    decimal = "." if separator == "," else _decimal_mark(sample_cells)
    names = _cells(rows[0][1], separator)
    digits = sum(bool(NUMBER.fullmatch(cell)) for cell in names)
    if digits >= 0.5 * len(names) or all(NUMBER.fullmatch(cell) or cell.lower() in MISSING for cell in names):
        names = _commented_names(comments, rows[0][0], separator, width)
        if not names:
            names = [f"column {i + 1}" for i in range(width)]
            notes.append(
                f"{path.name}, line {rows[0][0]}: there is no header; the columns are {names[0]} to {names[-1]}"
            )
    else:
        header, rows = rows[0], rows[1:]
        rows = [(i, line) for i, line in rows if line != header[1]]  # concatenated files repeat their header
    if width == len(names) + 1 and all(not _cells(line, separator)[-1] for line in sample[1:]):
        names.append("")  # each row ends with a separator
    if rows and (units := _unit_row(rows[0][1], separator, len(names))):
        names = [f"{name} [{unit}]" if unit else name for name, unit in zip(names, units, strict=True)]
        rows = rows[1:]
    if rows and (not whole or len(_cells(rows[-1][1], separator)) < len(names)):
        i, line = rows.pop()
        cells = len(_cells(line, separator))
        notes.append(
            f"{path.name}, line {i}, the last: half written ({cells} of {len(names)} cells): left out"
            if cells < len(names)
            else f"{path.name}, line {i}, the last: it has no end, so that its last number may be cut: left out"
        )
    if not rows:
        raise NoSource(f"{path}: the file has a header, but no whole row of numbers")
    return _Dialect(separator, decimal, _unique(names), [line for _, line in rows], [i for i, _ in rows], notes)


def _decimal_mark(cells: list[str]) -> str:
    """Return the decimal mark of most numbers. One that may be a mark between thousands counts only without others."""
    marks, unsure = Counter[str](), Counter[str]()
    for cell in cells:
        dots, commas = cell.count("."), cell.count(",")
        grouped = {mark for mark, form in GROUPED.items() if form.fullmatch(cell)}
        if grouped and ((dots and commas) or dots + commas > 1):
            marks.update(grouped)
        elif NUMBER.fullmatch(cell) and dots + commas:
            (unsure if grouped else marks)["," if commas else "."] += 1
    marks = marks or unsure
    return "," if marks[","] > marks["."] else "."


def _text(path: Path) -> tuple[str, bool]:
    """Return the text of a file, and whether its last line is whole."""
    data = path.read_bytes()
    encoding = "utf-16" if data[:2] in (b"\xff\xfe", b"\xfe\xff") else "utf-8-sig"
    text = data.decode(encoding, errors="replace")
    if "\ufffd" in text and text.replace("\ufffd", "").isascii():  # no letter is UTF-8: a Windows program wrote it
        text = data.decode("cp1252", errors="replace")
    return text.replace("\0", ""), text.endswith(("\n", "\r"))


def _separator(sample: list[str]) -> str:
    """Return the separator that splits most lines into the same number of cells, more than one."""

    def agreement(separator: str) -> float:
        counts = Counter(len(_cells(line, separator)) for line in sample)
        cells, lines = counts.most_common(1)[0]
        return lines / len(sample) if cells > 1 else 0.0

    shares = {one: agreement(one) for one in SEPARATORS}
    best = max(shares.values())
    if best == 0.0:
        return ","
    # A header whose names hold spaces, or rows of decimal commas, agree less often: prefer the first near the best.
    return next(one for one, share in shares.items() if share >= best - 0.05)


def _cells(line: str, separator: str) -> list[str]:
    if separator == " ":
        cells = line.split()
    elif '"' in line:
        cells = next(quoted.reader([line], delimiter=separator, skipinitialspace=True))
    else:
        cells = line.split(separator)
    return [cell.strip().strip('"').strip() for cell in cells]


def _commented_names(comments: list[tuple[int, str]], before: int, separator: str, width: int) -> list[str]:
    """Return the names in the last comment above the rows that has a name for each column; else none."""
    for i, line in reversed(comments):
        text = COMMENT.sub("", line, count=1).strip()
        for names in (*(_cells(text, one) for one in (separator, ",")), re.split(r"\t+|\s{2,}", text), text.split()):
            if i < before and len(names) == width and not any(NUMBER.fullmatch(name) for name in names):
                return names
    return []


def _unit_row(line: str, separator: str, width: int) -> list[str]:
    """Return the units in a row without numbers below the header; else none."""
    cells = _cells(line, separator)
    words = [cell.strip("[]()") for cell in cells]
    is_units = any(words) and not any(NUMBER.fullmatch(word) or word.lower() in MISSING[1:] for word in words)
    return words if is_units and len(words) == width and all(len(word) <= 6 for word in words) else []


def _unique(names: list[str]) -> list[str]:
    """Return the names; names that occur twice get the number of their column, so that none is taken in silence."""
    counts = Counter(names)
    return [name if name and counts[name] == 1 else f"{name} (column {i})".strip() for i, name in enumerate(names, 1)]


def _numbers(column: arrow.ChunkedArray, decimal: str, lines: np.ndarray) -> tuple[Array | None, str]:
    """Return the numbers of a column, times in s since 1970, and a note on what is left out; None for text."""
    kind = column.type
    if arrow.types.is_null(kind):
        return None, ""
    if arrow.types.is_timestamp(kind) or arrow.types.is_date(kind):
        nanoseconds = column.cast(arrow.timestamp("ns")).cast(arrow.int64()).to_numpy(zero_copy_only=False)
        return np.asarray(nanoseconds, float) / 1e9, ""
    if not (arrow.types.is_string(kind) or arrow.types.is_time(kind)):
        return np.asarray(column.to_numpy(), float), ""
    cells = ["" if cell is None else str(cell).strip() for cell in column.to_pylist()]
    values, bad, thousands = np.full(len(cells), np.nan), [], _thousands(cells, decimal)
    if thousands is None:
        i = next(i for i, cell in enumerate(cells) if GROUPED[decimal].fullmatch(cell))
        return None, (
            f"line {lines[i]}: {cells[i]} has a mark between thousands, or another decimal mark than other columns: "
            "the column is left out. Write the file without marks between thousands"
        )
    for i, cell in enumerate(cells):
        try:
            values[i] = _number(cell, decimal, thousands)
        except ValueError:
            bad.append(i)
    if not bad:
        return values, ""
    if len(bad) > max(DAMAGED * len(cells), NAMED) or len(bad) == len(cells):
        return None, f"line {lines[bad[0]]}: it holds text ({cells[bad[0]][:20]!r}): the column is left out"
    return values, f"{_listed([int(lines[i]) for i in bad])}: no number ({cells[bad[0]]!r}): the cell is left out"


def _thousands(cells: list[str], decimal: str) -> bool | None:
    """Return whether the numbers of a column have marks or spaces between thousands; None: nobody can tell.

    1.234 may be 1234 in a file with decimal commas, or a number of a column with decimal points.
    """
    grouped = [cell for cell in cells if GROUPED[decimal].fullmatch(cell)]
    other = "." if decimal == "," else ","
    if any(cell.count(other) != 1 or decimal in cell for cell in grouped):
        return True
    one_mark = re.compile(rf"[-+]?(?:0|\d+{other}(?!\d{{3}}$)|\d{{4,}}{other}).*")
    return None if grouped and not any(other in cell and one_mark.fullmatch(cell) for cell in cells) else False


def _number(cell: str, decimal: str, thousands: bool = False) -> float:
    """Return the number in a cell; of a date or a time (ISO 8601) its seconds. Raises ValueError for other text.

    thousands: there may be marks or spaces between thousands, so that such a mark is no decimal one.
    """
    if cell.lower() in MISSING:
        return math.nan
    if thousands and GROUPED[decimal].fullmatch(cell):
        return float(re.sub(rf"[^-+\d{decimal}]", "", cell).replace(decimal, "."))
    if thousands and decimal == "," and "." in cell:
        raise ValueError(f"{cell} has another decimal mark than other cells of its column")
    if ":" not in cell:
        return float(cell.replace(decimal, "."))
    if "-" in cell:
        moment = datetime.fromisoformat(cell)
        return (moment if moment.tzinfo else moment.replace(tzinfo=UTC)).timestamp()
    of_day = time.fromisoformat(cell)
    return of_day.hour * 3600.0 + of_day.minute * 60.0 + of_day.second + 1e-6 * of_day.microsecond


def _listed(lines: list[int]) -> str:
    """Return line numbers as text, at most `NAMED` of them."""
    more = f" and {len(lines) - NAMED} more" if len(lines) > NAMED else ""
    return f"line{'s' * (len(lines) > 1)} {', '.join(map(str, lines[:NAMED]))}{more}"

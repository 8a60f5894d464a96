"""Read JSON lines (one object a line) and JSON files with one array of objects, as files of columns.

The numbers within nested objects and arrays are columns too: `pose.x`, `velocity[0]`.
"""

from __future__ import annotations

import json
from array import array
from collections.abc import Iterator
from datetime import UTC, datetime
from math import nan
from pathlib import Path
from typing import Any

import numpy as np

from brakeline.deploy.data.sources.source_table import Table
from brakeline.errors import NoSource

DAMAGED = 0.01  # largest share of lines that is left out
NAMED = 3  # damaged lines that a message names


def read(path: Path) -> list[Table]:
    """Read the numbers of all objects; a moment in ISO 8601 counts in s since 1970.

    Damaged lines are left out, and a note names them, as long as they are few.

    Raises:
        NoSource: the file contains no object, or too many damaged lines.
    """
    columns: dict[str, array[float]] = {}
    lines, damaged = array("q"), dict[int, str]()
    for number, row in _rows(path):
        if not isinstance(row, dict):
            damaged[number] = row if isinstance(row, str) else "it is not an object"
            continue
        values = dict(_numbers("", row))
        for name in values.keys() - columns.keys():
            columns[name] = array("d", [nan]) * len(lines)
        for name, column in columns.items():
            column.append(values.get(name, nan))
        lines.append(number)
    where = ", ".join(f"line {number}: {why}" for number, why in list(damaged.items())[:NAMED])
    if not lines or len(damaged) > max(DAMAGED * len(lines), NAMED):
        raise NoSource(
            f"{path}: {len(damaged)} of {len(damaged) + len(lines)} lines are no JSON objects ({where or 'none'}). "
            "Write one object a line, with the time and the numbers of one row"
        )
    notes = (f"{path.name}: {len(damaged)} damaged lines are left out ({where})",) if damaged else ()
    arrays = {name: np.array(column) for name, column in columns.items()}
    return [Table("", np.zeros(0), arrays, notes=notes, lines=np.array(lines, np.intp))]


def _rows(path: Path) -> Iterator[tuple[int, Any]]:
    """Yield the number and the content of each line, or of each object of an array; text if it is damaged."""
    with path.open(encoding="utf-8-sig", errors="replace") as file:
        first = file.readline()
        file.seek(0)
        if first.lstrip().startswith("["):
            content = _parsed(file.read())
            yield from enumerate(content if isinstance(content, list) else [content], 1)
            return
        for number, line in enumerate(file, 1):
            if line.strip():
                yield number, _parsed(line)


def _parsed(text: str) -> Any:
    try:
        content = json.loads(text)
    except (ValueError, RecursionError) as error:
        return str(error)
    return None if isinstance(content, str) else content


def _numbers(name: str, value: Any) -> Iterator[tuple[str, float]]:
    """Yield the numbers within a value, with their names."""
    if isinstance(value, dict):
        for key, inner in value.items():
            yield from _numbers(f"{name}.{key}" if name else key, inner)
    elif isinstance(value, list):
        for i, inner in enumerate(value):
            yield from _numbers(f"{name}[{i}]", inner)
    elif isinstance(value, int | float):
        yield name, _finite_range(value)
    elif isinstance(value, str) and ":" in value and (moment := _moment(value)) is not None:
        yield name, moment


def _finite_range(value: float) -> float:
    try:
        return float(value)
    except OverflowError:  # an integer of more than 300 digits
        return nan


def _moment(text: str) -> float | None:
    try:
        moment = datetime.fromisoformat(text)
        return (moment if moment.tzinfo else moment.replace(tzinfo=UTC)).timestamp()
    except (ValueError, OverflowError):
        return None

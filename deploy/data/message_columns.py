"""Recognise the fields of ROS messages and trajectory files among the columns of a file, and name what they hold."""

from __future__ import annotations

import re
from collections.abc import Iterable
from dataclasses import replace

import numpy as np

from brakeline.deploy.data.sources.source_table import Array, Table
from brakeline.deploy.data.unit_table import split_header

# The last part of a column's name, and the name that a description has for it.
FIELDS = {
    **{axis: rf"(?:position[._]|^p_rs_r_|^t){axis}" for axis in "xyz"},
    **{"speed": r"linear[._]x", "speed aside": r"linear[._]y", "turn rate": r"angular[._]z"},
}
QUATERNION = {part: rf"(?:orientation[._]|^q_rs_|^q_?){part}" for part in "xyzw"}
HEADING = "heading"


def fields_of(names: Iterable[str], table: Table) -> list[str]:
    """Return the columns, without the units of their headers, to which `with_message_fields` gives some names."""
    patterns = [FIELDS[name] for name in names if name in FIELDS and name not in table.columns]
    plain = [split_header(column)[0] for column in table.columns]
    return [column for column in plain if any(re.search(rf"{one}$", column, re.IGNORECASE) for one in patterns)]


def with_message_fields(table: Table) -> Table:
    """Return the table with the columns x, y, heading, speed, … that the names of its fields show.

    A heading follows from a quaternion. A name that exists, or that several columns show, stays as it is.
    """
    added: dict[str, Array] = {}
    origins: list[str] = []
    for name, pattern in FIELDS.items():
        column = _only(table, pattern)
        if column and name not in table.columns:
            added[name] = table.columns[column]
            origins.append(f"{name} is {column}")
    parts = [_only(table, pattern) for pattern in QUATERNION.values()]
    if all(parts) and HEADING not in table.columns:
        x, y, z, w = (table.columns[part] for part in parts)
        added[HEADING] = np.arctan2(2.0 * (w * z + x * y), w * w + x * x - y * y - z * z)
        origins.append(f"{HEADING} follows from the quaternion {parts[0]}, …")
    if not {"x", "y"} <= {*added, *table.columns}:
        return table  # no pose: these are not the fields of odometry
    used = {column for pattern in (*FIELDS.values(), *QUATERNION.values()) if (column := _only(table, pattern))}
    columns = {name: values for name, values in table.columns.items() if name not in used} if added else table.columns
    notes = (*table.notes, f"columns: {'; '.join(origins)}") if origins else table.notes
    return replace(table, columns=columns | added, notes=notes)


def _only(table: Table, pattern: str) -> str:
    """Return the only column that a pattern matches at its end; empty if there is none, or several."""
    matches = [name for name in table.columns if re.search(rf"{pattern}$", name.strip(), re.IGNORECASE)]
    return matches[0] if len(matches) == 1 else ""

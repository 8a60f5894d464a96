"""Collect rows of messages and convert them to tables, for the readers of MAVLink and ArduPilot logs."""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Callable
from pathlib import Path
from typing import Any

from brakeline.deploy.data.sources.angles import from_ned
from brakeline.deploy.data.sources.quantity_names import AXES
from brakeline.deploy.data.sources.source_table import Table, table_of
from brakeline.errors import NoSource

Row = dict[str, float]
Kinds = dict[
    str, tuple[int, Callable[[Any], Row | None]]
]  # message type -> (rank, function that returns added quantities)


def vector(kind: str, ned: tuple[float, float, float]) -> Row:
    """Convert a vector from NED to named quantities in ENU."""
    return {f"{kind}.{axis}": value for axis, value in zip(AXES, from_ned(*ned), strict=True)}


def along_body(velocity: Row, yaw: float) -> Row:
    """Convert a velocity to forward, left and up."""
    x, y = velocity["velocity.x"], velocity["velocity.y"]
    cos, sin = math.cos(yaw), math.sin(yaw)
    return {"body.x": cos * x + sin * y, "body.y": cos * y - sin * x, "body.z": velocity["velocity.z"]}


class MessageRows:
    """The rows of one file, by message type."""

    def __init__(self, path: Path, kinds: Kinds) -> None:
        self.path, self.kinds = path, kinds
        self.stamps: dict[str, list[int]] = defaultdict(list)
        self.rows: dict[str, list[Row]] = defaultdict(list)

    def add(self, kind: str, micros: int, message: Any) -> None:
        """Add a message with its time stamp in µs."""
        row = self.kinds[kind][1](message)
        if row is not None:
            fields = message.to_dict().items()
            numbers = {name: float(value) for name, value in fields if isinstance(value, int | float)}
            self.stamps[kind].append(1000 * micros)
            self.rows[kind].append(numbers | row)

    def tables(self) -> list[Table]:
        """Return one table per message type. Raises NoSource if there is no message."""
        if not self.rows:
            raise NoSource(f"{self.path}: the log contains none of the messages {', '.join(self.kinds)}")
        since = min(min(stamps) for stamps in self.stamps.values())
        return [table_of(k, self.stamps[k], rows, since, self.kinds[k][0]) for k, rows in self.rows.items()]

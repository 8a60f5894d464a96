"""Rows of messages, by kind, on the way to tables: what the readers of MAVLink and of ArduPilot's logs share."""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Callable
from pathlib import Path
from typing import Any

from brakeline.deploy.data.sources.angles import from_ned
from brakeline.deploy.data.sources.quantity_names import AXES
from brakeline.deploy.data.sources.source_table import NoSource, Table, table_of

Row = dict[str, float]
Kinds = dict[str, tuple[int, Callable[[Any], Row | None]]]  # a kind's rank, and what a message of it adds to its fields


def vector(kind: str, ned: tuple[float, float, float]) -> Row:
    """A vector in NED by the names that quantities have in ENU."""
    return {f"{kind}.{axis}": value for axis, value in zip(AXES, from_ned(*ned), strict=True)}


def along_body(velocity: Row, yaw: float) -> Row:
    """The same velocity forward, left and up."""
    x, y = velocity["velocity.x"], velocity["velocity.y"]
    cos, sin = math.cos(yaw), math.sin(yaw)
    return {"body.x": cos * x + sin * y, "body.y": cos * y - sin * x, "body.z": velocity["velocity.z"]}


class Kept:
    """Of one file."""

    def __init__(self, path: Path, kinds: Kinds) -> None:
        self.path, self.kinds = path, kinds
        self.stamps: dict[str, list[int]] = defaultdict(list)
        self.rows: dict[str, list[Row]] = defaultdict(list)

    def take(self, kind: str, micros: int, message: Any) -> None:
        row = self.kinds[kind][1](message)
        if row is not None:
            fields = message.to_dict().items()
            numbers = {name: float(value) for name, value in fields if isinstance(value, int | float)}
            self.stamps[kind].append(1000 * micros)
            self.rows[kind].append(numbers | row)

    def tables(self) -> list[Table]:
        """Raises NoSource: there are none."""
        if not self.rows:
            raise NoSource(f"{self.path}: none of {', '.join(self.kinds)} is in it")
        since = min(min(stamps) for stamps in self.stamps.values())
        return [table_of(k, self.stamps[k], rows, since, self.kinds[k][0]) for k, rows in self.rows.items()]

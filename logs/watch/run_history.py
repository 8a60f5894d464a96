"""The counts of a run, and their history over its steps in a bounded number of rows.

The launcher sends both in its Health messages, for viewers that start later than the run: the count NAME of a robot
kind in the figure `ROBOT NAME`, the rows in a note.
"""

from __future__ import annotations

import itertools
import json
import math
from collections.abc import Mapping
from typing import Any

from brakeline.errors import BadText
from brakeline.logs.metrics import Metrics
from brakeline.messaging.structured_text import parse_json

NOTE = "history"  # of the launcher's Health message
COLUMNS = ("steps", "episodes", "goals", "collisions", "interventions", "reward")
MOST_ROWS = 48
FIRST_WIDTH = 50.0  # steps between two rows
MOST_ROBOTS = 50

History = dict[str, list[list[float]]]  # by robot kind: rows of COLUMNS, each counted from the run's beginning


COUNTS = ("steps", "episodes", "goals", "collisions", "interventions", "failsafes", "reward")  # reward: the sum

Totals = dict[str, dict[str, float]]  # by robot kind and name of the count


def run_totals(metrics: Metrics) -> Totals:
    """Return the counts of the metrics, which another thread may extend meanwhile."""
    totals: Totals = {}
    for stats in metrics.actors.copy().values():
        if stats.robot:
            counts = totals.setdefault(stats.robot, dict.fromkeys(COUNTS, 0.0))
            returns = stats.returns[:]
            counts["episodes"] += len(returns)
            # An episode of which a part is missing counts with the mean of the others.
            whole = [value for value in returns if math.isfinite(value)]
            counts["reward"] += math.fsum(whole) * len(returns) / max(1, len(whole))
            for name in ("steps", "goals", "collisions", "interventions", "failsafes"):
                counts[name] += getattr(stats, name)
    return totals


def totals_to_health(totals: Totals) -> dict[str, float]:
    """Encode counts as figures of a Health message."""
    return {f"{robot} {name}": value for robot, counts in totals.items() for name, value in counts.items()}


def totals_from_health(figures: Mapping[str, float]) -> Totals:
    """Decode counts from a Health message, without robot kinds whose counts are incomplete or invalid."""
    totals: Totals = {}
    for key, value in figures.items():
        robot, _, name = key.partition(" ")
        if name in COUNTS and math.isfinite(value) and (value >= 0.0 or name == "reward"):
            totals.setdefault(robot, {})[name] = value
    return {robot: counts for robot, counts in totals.items() if len(counts) == len(COUNTS)}


class RunHistory:
    """The rows of each robot kind. If there are too many, each second one goes, and the rest are twice as far apart."""

    def __init__(self) -> None:
        self.rows: History = {}
        self._width: dict[str, float] = {}

    def add(self, totals: Totals) -> None:
        """Add the counts of this moment, if the robots have driven far enough since the last row."""
        for robot, counts in totals.items():
            rows, width = self.rows.setdefault(robot, []), self._width.setdefault(robot, FIRST_WIDTH)
            row = [round(counts[name], 1) for name in COLUMNS]
            if row[0] < (rows[-1][0] if rows else 0.0) + width or not all(map(math.isfinite, row)):
                continue
            rows.append(row)
            if len(rows) > MOST_ROWS:
                self.rows[robot], self._width[robot] = rows[1::2], 2.0 * width


def history_to_note(history: History) -> str:
    """Encode rows as a note of a Health message."""
    whole = {robot: [[int(v) if v == int(v) else v for v in row] for row in rows] for robot, rows in history.items()}
    return json.dumps(whole, separators=(",", ":"))


def history_from_note(note: str) -> History:
    """Decode a note; robot kinds whose rows are malformed are left out."""
    try:
        decoded = parse_json(note)
    except BadText:
        return {}
    if not isinstance(decoded, dict) or len(decoded) > MOST_ROBOTS:
        return {}
    return {robot: rows for robot, rows in decoded.items() if _well_formed(rows)}


def _well_formed(rows: Any) -> bool:
    """Return whether the rows are finite numbers, and their steps grow."""
    if not isinstance(rows, list) or len(rows) > MOST_ROWS:
        return False
    for row in rows:
        if not isinstance(row, list) or len(row) != len(COLUMNS):
            return False
        if not all(isinstance(v, int | float) and not isinstance(v, bool) and math.isfinite(v) for v in row):
            return False
    return all(one[0] < other[0] for one, other in itertools.pairwise(rows))

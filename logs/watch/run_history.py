"""Keep the counts of a run over its steps in a bounded number of rows, for curves from the run's beginning.

The launcher sends its rows in a note of its Health messages, for viewers that start later than the run.
"""

from __future__ import annotations

import itertools
import json
import math
from typing import Any

from brakeline.errors import BadText
from brakeline.logs.watch.run_totals import Totals
from brakeline.messaging.structured_text import parse_json

NOTE = "history"  # of the launcher's Health message
COLUMNS = ("steps", "episodes", "goals", "collisions", "interventions", "reward")
MOST_ROWS = 48
FIRST_WIDTH = 50.0  # steps between two rows
MOST_ROBOTS = 50

History = dict[str, list[list[float]]]  # by robot kind: rows of COLUMNS, each counted from the run's beginning


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

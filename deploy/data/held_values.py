"""Find rows that repeat an earlier pose: a log that is written faster than the robot is located, or a lost pose.

A repeated pose is no measurement. If it counted as one, the path between two measurements would look straight, and the
chord deviation would be too small.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from brakeline.deploy.data.gap_free_recordings import GAP
from brakeline.deploy.data.glitches import FEWEST_ROWS, SPIKE, place_of
from brakeline.deploy.data.sources.quantity_names import Place, Places, with_values
from brakeline.deploy.data.sources.source_table import Array

Flags = NDArray[np.bool_]

LOST = 5  # times the usual rows with one pose: if it then jumps, the pose was lost
REGULAR = 0.9  # share of the changes of a position that are the usual number of rows apart, or one more or less
ALSO_HELD = 0.95  # share of a column's changes that are in rows with a new pose: it is written with the pose


def without_held_poses(
    places: Places, positions: Sequence[str], heading: str, states: Sequence[str]
) -> tuple[Places, list[str]]:
    """Return the places with repeated poses as missing values, and notes on them.

    A robot that stands may repeat its pose too. So every n-th row counts as a measurement, if the pose usually changes
    every n-th row. A position may be repeated beside a heading of another sensor.

    Args:
        places: table and field of each column.
        positions: columns of the position. Without any, all states count as the pose.
        heading: column of the heading; empty for none.
        states: columns of all coordinates; those that are written with the pose are left out with it.
    """
    pose = [*positions, *([heading] if heading else [])]
    if not pose:
        return _without_held(places, states, states, REGULAR)
    places, notes = _without_held(places, pose, states, 0.0)
    places, more = _without_held(places, positions, states, REGULAR) if heading else (places, [])
    return places, notes + more


def _without_held(
    places: Places, pose: Sequence[str], states: Sequence[str], regular: float
) -> tuple[Places, list[str]]:
    """Return the places with repeated values of the columns `pose`, if these share a table, as missing values.

    regular: share of the changes that must be n rows apart. A slow robot repeats its position in whole centimetres too,
    but for another number of rows each time.
    """
    if any(places[name][0].time is not places[pose[0]][0].time for name in pose):
        return places, []
    table = places[pose[0]][0]
    rows = np.flatnonzero(np.isfinite([places[name][0].columns[places[name][1]] for name in pose]).all(0))
    rows = rows[np.diff(table.time[rows], prepend=-np.inf) != 0.0]
    if len(rows) < FEWEST_ROWS:
        return places, []
    values = np.column_stack([places[name][0].columns[places[name][1]][rows] for name in pose])
    moved = np.abs(np.diff(values, axis=0, prepend=values[:1] - 1.0))
    time = table.time[rows]
    begins = np.diff(time, prepend=-np.inf) > GAP * np.median(np.diff(time))
    if len(table.run):
        begins |= np.diff(table.run[rows], prepend=-1) != 0
    new: Flags = np.asarray((moved > 0.0).any(1) | begins)
    at = np.flatnonzero(new)
    every = int(np.median(np.diff(at))) if len(at) > FEWEST_ROWS else 1
    if every > 1 and np.mean(np.abs(np.diff(at) - every) <= 1) < regular:
        every = 1
    lost = np.zeros(len(rows), bool)
    notes = []
    for i, j in _lost(moved, begins, at, every):
        lost[i + 1 : j] = True
        seconds = time[j - 1] - time[i]
        notes.append(
            f"{place_of(table, int(rows[i]))}: the pose stays the same for {seconds:.3g} s, then jumps: left out"
        )
    since = np.arange(len(rows)) - np.maximum.accumulate(np.where(new, np.arange(len(rows)), 0))
    measured = (since % every == 0) & ~lost
    if measured.all():
        return places, []
    if every > 1:
        seconds = float(np.median(np.diff(time[measured])))
        notes.append(
            f"{', '.join(pose)} change only in every {_ordinal(every)} row: the rows between repeat them, and do not "
            f"count as measurements (one every {seconds:.3g} s)"
        )
    repeated = rows[~measured]
    written = [
        *pose,
        *(name for name in states if name not in pose and _with_pose(places, name, table.time, rows, new)),
    ]
    return {**places, **{name: _without(places, name, repeated) for name in written}}, notes


def _lost(moved: Array, begins: Flags, at: NDArray[np.intp], every: int) -> list[tuple[int, int]]:
    """Return the first row of each stretch of one pose that ends in a jump, and the row of the jump.

    Args:
        moved: (n, d) how far each coordinate moved since the row before.
        begins: (n,) whether a row begins a recording, before which the robot may have been anywhere.
        at: rows with a new pose.
        every: usual number of rows from one pose to the next.
    """
    if begins.all():
        return []
    usual = np.quantile(moved[~begins], 0.99, axis=0)
    jumps = (moved > SPIKE * np.maximum(usual, 1e-9)).any(1) & ~begins
    return [(int(i), int(j)) for i, j in pairwise(at) if j - i > LOST * every and jumps[j]]


def _with_pose(places: Places, name: str, time: Array, rows: NDArray[np.intp], new: Flags) -> bool:
    """Return whether a column of the pose's table changes with the pose only."""
    table, column = places[name]
    if table.time is not time:
        return False
    changes = np.diff(table.columns[column][rows], prepend=np.nan) != 0.0
    return bool(np.count_nonzero(changes & new) >= ALSO_HELD * np.count_nonzero(changes))


def _without(places: Places, name: str, rows: NDArray[np.intp]) -> Place:
    table, column = places[name]
    values = table.columns[column].copy()
    values[rows] = np.nan
    return with_values((table, column), values)


def _ordinal(number: int) -> str:
    return {2: "second", 3: "third"}.get(number, f"{number}th")

"""Find rows that repeat an earlier pose: a log that is written faster than the robot is located, or a lost pose.

A repeated pose is no measurement. If it counted as one, the path between two measurements would look straight, and the
chord deviation would be too small.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from brakeline.deploy.data.glitches import FEWEST_ROWS, SPIKE, place_of
from brakeline.deploy.data.sources.quantity_names import Places, with_values
from brakeline.deploy.data.sources.source_table import Array

Flags = NDArray[np.bool_]

LOST = 5  # times the usual rows with one pose: if it then jumps, the pose was lost
ALSO_HELD = 0.95  # share of a column's changes that are in rows with a new pose: it is written with the pose


def without_held_poses(places: Places, pose: Sequence[str], states: Sequence[str]) -> tuple[Places, list[str]]:
    """Return the places with repeated poses as missing values, and notes on them.

    A robot that stands may repeat its pose too. So every n-th row counts as a measurement, if the pose usually changes
    every n-th row.

    Args:
        places: table and field of each column.
        pose: columns of the position, and the heading if there is one. They are compared if they share a table.
        states: columns of the other coordinates; those that are written with the pose are left out with it.
    """
    if not pose or any(places[name][0].time is not places[pose[0]][0].time for name in pose):
        return places, []
    table = places[pose[0]][0]
    rows = np.flatnonzero(np.isfinite([places[name][0].columns[places[name][1]] for name in pose]).all(0))
    rows = rows[np.diff(table.time[rows], prepend=-np.inf) != 0.0]
    if len(rows) < FEWEST_ROWS:
        return places, []
    values = np.column_stack([places[name][0].columns[places[name][1]][rows] for name in pose])
    moved = np.abs(np.diff(values, axis=0, prepend=values[:1] - 1.0))
    new = (moved > 0.0).any(1)
    if len(table.run):
        new |= np.diff(table.run[rows], prepend=-1) != 0
    at = np.flatnonzero(new)
    every = int(np.median(np.diff(at))) if len(at) > FEWEST_ROWS else 1
    lost, notes = _lost(table.time[rows], moved[:, : len(pose)], at, every)
    notes = [f"{place_of(table, int(rows[i]))}: {text}" for i, text in notes]
    since = np.arange(len(rows)) - np.maximum.accumulate(np.where(new, np.arange(len(rows)), 0))
    measured = (since % every == 0) & ~lost
    if measured.all():
        return places, []
    if every > 1:
        seconds = float(np.median(np.diff(table.time[rows[measured]])))
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


def _lost(time: Array, moved: Array, at: NDArray[np.intp], every: int) -> tuple[Flags, list[tuple[int, str]]]:
    """Return the rows of stretches of one pose that end in a jump, each with a note at its first row."""
    lost, notes = np.zeros(len(time), bool), list[tuple[int, str]]()
    usual = np.quantile(moved[at[1:]], 0.99, axis=0) if len(at) > 1 else np.inf
    for i, j in pairwise(at):
        if j - i > LOST * every and (moved[j] > SPIKE * np.maximum(usual, 1e-9)).any():
            lost[i + 1 : j] = True
            notes.append((int(i), f"the pose stays the same for {time[j - 1] - time[i]:.3g} s, then jumps: left out"))
    return lost, notes


def _with_pose(places: Places, name: str, time: Array, rows: NDArray[np.intp], new: Flags) -> bool:
    """Return whether a column of the pose's table changes with the pose only."""
    table, column = places[name]
    if table.time is not time:
        return False
    changes = np.diff(table.columns[column][rows], prepend=np.nan) != 0.0
    return bool(np.count_nonzero(changes & new) >= ALSO_HELD * np.count_nonzero(changes))


def _without(places: Places, name: str, rows: NDArray[np.intp]) -> tuple:
    table, column = places[name]
    values = table.columns[column].copy()
    values[rows] = np.nan
    return with_values((table, column), values)


def _ordinal(number: int) -> str:
    return {2: "second", 3: "third"}.get(number, f"{number}th")

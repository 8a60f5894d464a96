"""Find glitches: a few rows whose value lies far outside what the column holds otherwise, and name them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import pairwise
from types import MappingProxyType

import numpy as np
from numpy.typing import NDArray

from brakeline.deploy.data.sources.quantity_names import Places, with_values
from brakeline.deploy.data.sources.source_table import Array, Table

Rows = NDArray[np.intp]

LONGEST = 5  # rows: a longer excursion is no glitch
MOST = 0.01  # largest share of the rows: more are no glitches
FEWEST_ROWS = 50  # a shorter column shows no usual range
TAIL = 0.005  # of the values at either end: the usual range is between
BEYOND = 2.0  # widths of the usual range beyond its ends
SPIKE = 10.0  # times the largest usual change from one row to the next
NAMED = 5  # glitches that notes name


def without_glitches(
    places: Places,
    positions: Sequence[str],
    heading: str,
    inputs: Mapping[str, tuple[float, float]] = MappingProxyType({}),
) -> tuple[Places, list[str]]:
    """Return the places with glitches as missing values, and notes that name them.

    Glitches of `inputs` are named, but they stay: the robot may have followed them. Most are beyond its bounds.

    Args:
        places: table and field of each column.
        positions: they have no usual range: a glitch jumps away and back.
        heading: the column of the heading in rad; as positions, but modulo 2 pi.
        inputs: bounds of the columns of inputs; the recording is cut at glitches that are beyond them.
    """
    clean, notes = dict(places), list[str]()
    for name, (table, column) in places.items():
        values = table.columns[column]
        if name == heading:
            rows = _spikes(_unwrapped(values))
        else:
            rows = _spikes(values) if name in positions else _outliers(values)
        if not len(rows):
            continue
        if name in inputs:
            beyond = (values[rows] < inputs[name][0]) | (values[rows] > inputs[name][1])
            notes += _named(table, column, rows[beyond], "the recording is cut there")
            notes += _named(table, column, rows[~beyond], "it counts, as it is within the bounds of the input")
        else:
            notes += _named(table, column, rows, "left out")
            known = values.copy()
            known[rows] = np.nan
            clean[name] = with_values((table, column), known)
    return clean, notes


def _named(table: Table, column: str, rows: Rows, cut: str) -> list[str]:
    """Return notes that name the first glitches of a column."""
    values = table.columns[column]
    usual = np.delete(values, rows)
    low, high = np.quantile(usual[np.isfinite(usual)], (TAIL, 1.0 - TAIL))
    what = f"is a glitch (usual: {low:.3g} to {high:.3g}): {cut}"
    notes = [f"{place_of(table, int(row))}, column {column}: {values[row]:.6g} {what}" for row in rows[:NAMED]]
    more = len(rows) - NAMED
    return notes + ([f"{more} more glitches of {column}: {cut}"] if more > 0 else [])


def place_of(table: Table, row: int) -> str:
    """Return file and line of a row, or its time."""
    where = (
        f"line {table.lines[row]}" if table.lines is not None else f"{table.name} at {table.time[row]:.3f} s".strip()
    )
    return f"{table.source}, {where}" if table.source else where


def _outliers(values: Array) -> Rows:
    """Return the rows of short excursions far outside the usual range."""
    finite = values[np.isfinite(values)]
    if len(finite) < FEWEST_ROWS:
        return np.zeros(0, np.intp)
    low, high = np.quantile(finite, (TAIL, 1.0 - TAIL))
    width = high - low
    if width <= 0.0:
        return np.zeros(0, np.intp)
    return _short((values < low - BEYOND * width) | (values > high + BEYOND * width) | np.isinf(values))


def _spikes(values: Array) -> Rows:
    """Return the rows to which a column jumps and from which it soon jumps back, for columns that go anywhere."""
    known = np.flatnonzero(np.isfinite(values))
    if len(known) < FEWEST_ROWS:
        return np.zeros(0, np.intp)
    change = np.abs(np.diff(values[known]))
    jumps = np.flatnonzero(change > SPIKE * max(float(np.quantile(change, 0.99)), 1e-9))
    spiked = np.zeros(len(values), bool)
    for i, j in pairwise(jumps):
        back = abs(float(values[known[j + 1]] - values[known[i]]))
        if j - i <= LONGEST and back < 0.3 * min(change[i], change[j]):
            spiked[known[i + 1 : j + 1]] = True
    return _short(spiked)


def _unwrapped(values: Array) -> Array:
    known, unwrapped = np.isfinite(values), values.copy()
    unwrapped[known] = np.unwrap(values[known])
    return unwrapped


def _short(flags: NDArray[np.bool_]) -> Rows:
    """Return the flagged rows in stretches of at most `LONGEST`; none if they are too many for glitches."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], flags, [False]]).astype(int)))
    rows = [np.arange(i, j) for i, j in zip(edges[::2], edges[1::2], strict=True) if j - i <= LONGEST]
    short = np.concatenate(rows) if rows else np.zeros(0, np.intp)
    return short if len(short) <= max(MOST * len(flags), 1) else np.zeros(0, np.intp)

"""Split the columns of a source into recordings without gaps, jumps of the pose and lost inputs."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from brakeline.deploy.data.sources.quantity_names import column_names
from brakeline.deploy.data.sources.source_table import Array, Series, Table
from brakeline.errors import NoSource
from brakeline.messaging.labels import split_label
from brakeline.messaging.robot import Robot

Span = tuple[float, float]  # begin and end in s
Indices = NDArray[np.signedinteger]

GAP = 1.5  # times the usual time between two samples: a larger one is a gap
REGULAR = 0.9  # share of the times between two messages of an input without a gap: its sender repeats it all the time
JUMP = 2.0  # times the fastest motion: faster is a jump
MOST_USUAL = 3.0  # times the fastest motion of the description, to which the usual speed of a log counts
MOST_JUMPS, FEW_JUMPS = 0.1, 5  # share and number of rows with jumps, above which the rows are of several robots


@dataclass(frozen=True)
class GapFreeRecording:
    """One run without gaps: a series per state coordinate and input, from `begin` to `end` in s."""

    states: list[Series]
    inputs: list[Series]
    begin: float
    end: float


def gap_free_recordings(
    places: dict[str, tuple[Table, str]], robot: Robot, delay: float, hold: float
) -> tuple[list[GapFreeRecording], list[str]]:
    """Return the recordings, with unwrapped headings, and notes on gaps and jumps.

    Args:
        places: table and field of each column of the robot.
        robot: gives the columns, the period and the fastest motion.
        delay: time in s by which the stamps of the inputs are too early.
        hold: time in s for which an input is valid after its last message.

    Raises:
        NoSource: a coordinate has less than one sample per period, its time decreases, or the rows are of several
            robots.
    """
    names, input_names = column_names(robot)
    recordings: list[GapFreeRecording] = []
    gaps = lost = silent = jumps = shared = 0
    cut_in = dict.fromkeys(names, 0)
    for run in sorted({int(i) for table, _ in places.values() for i in np.unique(table.run)} or {0}):
        states, given = (
            [table.series(column, run) for table, column in (places[name] for name in columns)]
            for columns in (names, input_names)
        )
        inputs = [(time + delay, values) for time, values in given]
        if any(len(time) < 2 for time, _ in states) or not all(len(time) for time, _ in inputs):
            continue
        cuts = [_gaps(time, robot.period, name) for (time, _), name in zip(states, names, strict=True)]
        jump_rows = _jumps(robot, states)
        moving, unreachable = _same_stamps(robot, [places[name] for name in names], run)
        jumping = sum(map(len, jump_rows.values())) + unreachable
        _refuse_several_robots(jumping, sum(len(states[i][0]) for i in jump_rows))
        shared += moving
        gaps += max(map(len, cuts))
        for name, at in zip(names, cuts, strict=True):
            cut_in[name] += len(at)
        jumps += len({float(states[i][0][j]) for i, indices in jump_rows.items() for j in indices})
        spans = [_uncut(time, at) for (time, _), at in zip(states, cuts, strict=True)]
        spans += [_uncut(states[i][0], indices) for i, indices in jump_rows.items()]
        spans += [_uncut(time, np.flatnonzero(np.diff(time) > hold), hold) for time, _ in inputs]
        end = min(time[-1] for time, _ in states)
        silent += len({float(at) for time, _ in inputs for at in time[np.diff(time, append=end) > hold]})
        losses = [_lost_messages(series, robot.period, hold) for series in inputs]
        lost += len({end for loss in losses for _, end in loss})
        spans += [_outside(loss) for loss in losses]
        if robot.heading is not None:
            time, heading = states[robot.heading]
            states[robot.heading] = time, np.unwrap(heading)
        for begin, end in _common(spans):
            part = [_within(series, begin, end) for series in states]
            if all(len(time) >= 2 for time, _ in part):
                recordings.append(GapFreeRecording(part, inputs, begin, end))
    counts = {
        "gaps, at which the recording is cut: {}": gaps,
        "jumps of the pose, at which the recording is cut: {}": jumps,
        "changes of an input while messages of it are missing, at which the recording is cut: {}": lost,
        f"pauses of more than {hold:g} s between messages of an input: {{}}. The recording leaves out what follows "
        f"these {hold:g} s. If the robot keeps an input until the next message, give a larger --hold": silent,
        "rows with the stamp of the row before and another pose, which are left out: {}": shared,
    }
    missing = [_missing_cells(name, *places[name]) for name, count in cut_in.items() if count]
    return recordings, [note.format(count) for note, count in counts.items() if count] + list(filter(None, missing))


def _missing_cells(name: str, table: Table, column: str) -> str:
    """Return a note on the rows in which a column has no value. Empty: it has one in all."""
    share = float(np.mean(~np.isfinite(table.columns[column][np.isfinite(table.time)])))
    said = f"{name} is empty or NaN in {share:.1%} of the rows: where it lacks half a period, the recording is cut"
    return said if share else ""


def _gaps(time: Array, period: float, name: str) -> Indices:
    """Return the indices of the samples before gaps. Raises NoSource if there are too few samples."""
    apart = np.diff(time)
    usual = float(np.median(apart))
    if usual > 1.05 * period:
        raise NoSource(
            f"{name} has a sample every {usual:.3g} s: the robot's period of {period:g} s needs at least one per period"
        )
    return np.flatnonzero(apart > _longest_step(usual, period))


def _longest_step(usual: float, period: float) -> float:
    """Return the time in s between two samples above which samples are missing for more than half a period.

    It lies halfway between two multiples of the usual time, so that noise of the stamps does not decide.
    """
    return usual * (max(math.floor(0.5 * period / usual + 0.01), 1) + GAP - 1.0)


def _lost_messages(series: Series, period: float, hold: float) -> list[Span]:
    """Return the times without messages of an input in which it changed, if its sender usually repeats it.

    Nobody knows when the robot got the new input. If the sender is silent for longer than `hold`, it does not send.
    """
    time, values = series
    apart = np.diff(time)
    usual = float(np.median(apart)) if len(apart) else 0.0
    gap = apart > (_longest_step(usual, period) if usual > 0.0 else np.inf)
    if not gap.any() or gap.mean() > 1.0 - REGULAR:
        return []
    return [
        (float(time[i] + usual), float(time[i + 1]))
        for i in np.flatnonzero(gap & (apart <= hold) & (np.diff(values) != 0.0))
    ]


def _outside(holes: list[Span]) -> list[Span]:
    """Return the spans of time outside holes, which are in order."""
    begins, ends = [-np.inf, *(end for _, end in holes)], [*(begin for begin, _ in holes), np.inf]
    return list(zip(begins, ends, strict=True))


def _pose(robot: Robot) -> tuple[int, ...]:
    """Return the indices of the coordinates of the pose."""
    return (*range(robot.position_dim), *(() if robot.heading is None else (robot.heading,)))


def _fastest(robot: Robot) -> dict[str, float]:
    """Return the fastest motion that the inputs' bounds allow, by unit; 0 if no input is in the unit."""
    fastest = {"m/s": 0.0, "rad/s": 0.0}
    for label, low, high in zip(robot.action, robot.action_low, robot.action_high, strict=True):
        if (unit := split_label(label)[1]) in fastest:
            fastest[unit] = float(np.hypot(fastest[unit], max(abs(low), abs(high))))
    return fastest


def _moved(robot: Robot, i: int, values: Array) -> Array:
    """Return how far a coordinate of the pose moved from each row to the next."""
    moved = np.diff(values)
    return np.abs((moved + np.pi) % (2.0 * np.pi) - np.pi if i == robot.heading else moved)


def _jumps(robot: Robot, states: list[Series]) -> dict[int, Indices]:
    """Return for each coordinate of the pose the indices of the samples before a motion faster than the robot's."""
    fastest, jump_rows = _fastest(robot), {}
    for i in _pose(robot):
        time, values = states[i]
        apart, moved = np.diff(time), _moved(robot, i, values)
        usual = float(np.quantile(moved / apart, 0.99))
        if known := fastest["rad/s" if i == robot.heading else "m/s"]:
            usual = max(known, min(usual, MOST_USUAL * known))
        jump_rows[i] = np.flatnonzero(moved > JUMP * usual * apart + 4.0 * robot.measurement_bound[i])
    return jump_rows


def _same_stamps(robot: Robot, places: Sequence[tuple[Table, str]], run: int) -> tuple[int, int]:
    """Return how many rows of a run have the stamp of the row before.

    Returns:
        The number of those with another pose, and of those with one that the robot cannot reach within a period.
    """
    fastest, moving, unreachable = _fastest(robot), 0, 0
    for i in _pose(robot):
        table, column = places[i]
        values = table.columns[column]
        rows = np.isfinite(table.time) & np.isfinite(values) & ((table.run == run) if len(table.run) else True)
        moved = _moved(robot, i, values[rows])[np.diff(table.time[rows]) == 0.0]
        within = JUMP * MOST_USUAL * fastest["rad/s" if i == robot.heading else "m/s"] * robot.period
        moving = max(moving, int(np.count_nonzero(moved)))
        if within:
            unreachable += int(np.count_nonzero(moved > within + 4.0 * robot.measurement_bound[i]))
    return moving, unreachable


def _refuse_several_robots(jumps: int, rows: int) -> None:
    """Raise NoSource if so many rows jump that they are of several robots."""
    if jumps > max(MOST_JUMPS * rows, FEW_JUMPS):
        raise NoSource(
            f"the pose jumps {jumps} times in {rows} values, faster than the robot moves: are these rows of several "
            "robots? Give a column `run` with another number for each recording, or one file for each robot"
        )


def _uncut(time: Array, cuts: Indices, hold: float = 0.0) -> list[Span]:
    """Return the spans of a series that is cut after the samples `cuts`; its values are valid for `hold` s."""
    starts, ends = [0, *(cuts + 1)], [*cuts, len(time) - 1]
    return [(float(time[i]), float(time[j]) + hold) for i, j in zip(starts, ends, strict=True)]


def _common(spans: Sequence[list[Span]]) -> list[Span]:
    """Return the intersection of the lists of spans."""
    common = spans[0]
    for other in spans[1:]:
        met = ((max(a, c), min(b, d)) for a, b in common for c, d in other if c < b and d > a)
        common = [(a, b) for a, b in met if a < b]
    return common


def _within(series: Series, begin: float, end: float) -> Series:
    """Return the samples from the last one at or before `begin` to the first one at or after `end`."""
    time, values = series
    i, j = max(int(np.searchsorted(time, begin, "right")) - 1, 0), int(np.searchsorted(time, end)) + 1
    return time[i:j], values[i:j]

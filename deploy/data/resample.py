"""Resample columns over time to trajectories with one state and one input per period.

States are interpolated linearly. The input of a period is the one that was held for most of it, or else the mean.
Periods begin where inputs change, if most inputs change at a common phase. A recording is split at gaps, at jumps of
the pose, and where an input is outside the robot's bounds. Angles are unwrapped first.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from brakeline.deploy.data.input_delay import estimate_delay, followed_inputs
from brakeline.deploy.data.sources.quantity_names import column_names, resolve, split
from brakeline.deploy.data.sources.source_table import Array, Table
from brakeline.errors import NoSource
from brakeline.messaging.obstacle import rotate
from brakeline.messaging.robot import Robot
from brakeline.safety.model.dataset import Dataset, Trajectory

HOLD = 1.0  # s for which an input is valid after its last message: later its sender may be gone
MOSTLY = 0.9  # share of a period: an input held for longer is the period's input
FEWEST_PERIODS = 5  # shorter trajectories are dropped
LONGEST, FEWEST_PARTS = 300, 60  # periods per trajectory; number of trajectories, so that 30 % can be held out
MAX_SAMPLES = 20  # positions per period
GAP = 1.5  # times the usual time between two samples: a larger one is a gap
PHASES = 40  # bins of the phase at which inputs change
JUMP = 2.0  # times the fastest motion: faster is a jump


@dataclass(frozen=True)
class ImportReport:
    """Figures of an import, and notes for the user."""

    periods: int
    trajectories: int
    samples: int  # positions per period in the source
    chord_deviation: float  # m, of the path between two positions
    delays: dict[str, float]  # s, for each input, to the coordinate that follows it
    uneven: float  # share of the periods in which an input changed
    notes: tuple[str, ...]


@dataclass(frozen=True)
class ImportedData:
    """A data set and the report of its import."""

    data: Dataset
    report: ImportReport


@dataclass(frozen=True)
class _Recording:
    """One run without gaps: a series (time, values) per state coordinate and input, from `begin` to `end` in s."""

    states: list[tuple[Array, Array]]
    inputs: list[tuple[Array, Array]]
    begin: float
    end: float


def resample(
    tables: Sequence[Table], robot: Robot, chosen: dict[str, str], delay: float = 0.0, hold: float = HOLD
) -> ImportedData:
    """Resample the tables of a source to a data set.

    Args:
        tables: the tables of the source.
        robot: its description gives period, columns and bounds.
        chosen: the field of each column that `--map` names.
        delay: time in s by which the stamps of the inputs are too early.
        hold: time in s for which an input is valid after its last message.

    Raises:
        NoSource: a column is missing, the source has too few samples, or no trajectory is left; the message gives the
            reason.
    """
    places = resolve(tables, robot, chosen)
    recordings, notes = _recordings(places, robot, delay, hold)
    if not recordings:
        raise NoSource("; ".join(notes) or "the columns have no time in common")
    step = float(np.median(np.concatenate([np.diff(r.states[0][0]) for r in recordings])))
    samples = int(np.clip(round(robot.period / step), 1, MAX_SAMPLES))
    pieces: list[Trajectory] = []
    changed, out = [], 0
    for recording in recordings:
        made, uneven, beyond = _trajectories(recording, robot, samples)
        pieces += made
        changed.append(uneven)
        out += beyond
    if out:
        notes.append(f"{out} periods left out: an input was outside the robot's bounds")
    if not pieces:
        raise NoSource("; ".join((*notes, f"fewer than {FEWEST_PERIODS} consecutive periods are left")))
    longest = int(np.clip(sum(len(t.inputs) for t in pieces) // FEWEST_PARTS, 4 * robot.horizon, LONGEST))
    parts = tuple(part for t in pieces for part in _split(t, longest))
    chord_deviation = _chord_deviation(robot, parts, samples)
    data = Dataset(robot, parts, {"origin": "import"}, chord_deviation)
    data.check()
    share = float(np.concatenate(changed).mean())
    delays = _delays(recordings, robot)
    notes += _notes(robot, samples, chord_deviation, share, delays)
    return ImportedData(
        data, ImportReport(data.periods, len(parts), samples, chord_deviation, delays, share, tuple(notes))
    )


# --- recordings without gaps --------------------------------------------------------------------------------------


def _recordings(
    places: dict[str, tuple[Table, str]], robot: Robot, delay: float, hold: float
) -> tuple[list[_Recording], list[str]]:
    names, inputs = column_names(robot)
    runs = sorted({int(i) for table, _ in places.values() for i in np.unique(table.run)} or {0})
    found: list[_Recording] = []
    gaps = jumps = 0
    for run in runs:
        states = [places[name][0].series(places[name][1], run) for name in names]
        given = [places[name][0].series(places[name][1], run) for name in inputs]
        given = [(time + delay, values) for time, values in given]
        if any(len(time) < 2 for time, _ in states) or any(len(time) < 1 for time, _ in given):
            continue
        spans = [[(-np.inf, np.inf)]]
        for (time, _), name in zip(states, names, strict=True):
            parts, missing = _without_gaps(time, robot.period, name)
            spans.append(parts)
            gaps += missing if name == names[0] else 0
        torn = _jumps(robot, states)
        jumps += len(torn)
        spans.append(_between_times(torn))
        spans += [_held_spans(time, hold) for time, _ in given]
        if robot.heading is not None:
            time, heading = states[robot.heading]
            states[robot.heading] = time, np.unwrap(heading)
        for begin, end in _common(spans):
            part = _Recording([_within(s, begin, end) for s in states], given, begin, end)
            if all(len(time) >= 2 for time, _ in part.states):
                found.append(part)
    notes = [f"{gaps} gaps"] if gaps else []
    return found, notes + ([f"{jumps} jumps of the pose"] if jumps else [])


def _without_gaps(time: Array, period: float, name: str) -> tuple[list[tuple[float, float]], int]:
    """Return the spans (begin, end) without gaps, and the number of gaps."""
    apart = np.diff(time)
    usual = float(np.median(apart))
    if usual > 1.05 * period:
        raise NoSource(
            f"{name} has a sample every {usual:.3g} s: the robot's period of {period:g} s needs at least one per period"
        )
    cuts = np.flatnonzero(apart > max(GAP * usual, 0.5 * period))
    starts, ends = np.concatenate([[0], cuts + 1]), np.concatenate([cuts, [len(time) - 1]])
    return [(float(time[i]), float(time[j])) for i, j in zip(starts, ends, strict=True)], len(cuts)


def _jumps(robot: Robot, states: list[tuple[Array, Array]]) -> list[tuple[float, float]]:
    """Return the spans (begin, end) in which the pose changed faster than the robot can move."""
    found = []
    speeds = {"m": 0.0, "rad": 0.0}
    for label, low, high in zip(robot.action, robot.action_low, robot.action_high, strict=True):
        if (kind := split(label)[1].removesuffix("/s")) in speeds and split(label)[1].endswith("/s"):
            speeds[kind] = float(np.hypot(speeds[kind], max(abs(low), abs(high))))
    pose = [*range(robot.position_dim), *([] if robot.heading is None else [robot.heading])]
    for i in pose:
        time, values = states[i]
        apart, moved = np.diff(time), np.abs(np.diff(values))
        if i == robot.heading:
            moved = np.abs((np.diff(values) + np.pi) % (2.0 * np.pi) - np.pi)
        usual = float(np.quantile(moved / apart, 0.99))
        most = JUMP * max(speeds["rad" if i == robot.heading else "m"], usual)
        torn = np.flatnonzero(moved > most * apart + 4.0 * robot.measurement_bound[i])
        found += [(float(time[j]), float(time[j + 1])) for j in torn]
    return sorted(set(found))


def _between_times(torn: list[tuple[float, float]]) -> list[tuple[float, float]]:
    edges = [(-np.inf, -np.inf), *torn, (np.inf, np.inf)]
    return [(a[1], b[0]) for a, b in pairwise(edges) if a[1] <= b[0]]


def _held_spans(time: Array, hold: float) -> list[tuple[float, float]]:
    """Return the spans in which an input is valid: from a message until `hold` s after the last one."""
    ends = np.flatnonzero(np.diff(time, append=np.inf) > hold)
    starts = np.concatenate([[0], ends[:-1] + 1])
    return [(float(time[i]), float(time[j]) + hold) for i, j in zip(starts, ends, strict=True)]


def _common(spans: list[list[tuple[float, float]]]) -> list[tuple[float, float]]:
    """Return the intersection of the lists of spans."""
    common = spans[0]
    for other in spans[1:]:
        met = ((max(a, c), min(b, d)) for a, b in common for c, d in _near(other, a, b))
        common = [(a, b) for a, b in met if a < b]
    return common


def _near(spans: list[tuple[float, float]], begin: float, end: float) -> Iterator[tuple[float, float]]:
    return ((c, d) for c, d in spans if c < end and d > begin)


def _within(series: tuple[Array, Array], begin: float, end: float) -> tuple[Array, Array]:
    """Return the samples from the last one at or before `begin` to the first one at or after `end`."""
    time, values = series
    i, j = max(int(np.searchsorted(time, begin, "right")) - 1, 0), int(np.searchsorted(time, end)) + 1
    return time[i:j], values[i:j]


# --- periods ------------------------------------------------------------------------------------------------------


def _trajectories(r: _Recording, robot: Robot, samples: int) -> tuple[list[Trajectory], Array, int]:
    """Return trajectories, a flag (T,) for each period in which an input changed, and how many were out of bounds."""
    period = robot.period
    begin = r.begin + _phase(r, period)
    count = int(np.floor((r.end - begin) / period + 1e-6))
    if count < 1:
        return [], np.zeros(0), 0
    edges: Array = np.asarray(begin + period * np.arange(count + 1), float)
    states = np.column_stack([np.interp(edges, time, values) for time, values in r.states])
    fine: Array = np.asarray(begin + period / samples * np.arange(count * samples + 1), float)
    d = robot.position_dim
    at = np.column_stack([np.interp(fine, time, values) for time, values in r.states[:d]])
    paths = at[1:].reshape(count, samples, d) - at[:-1:samples, None]
    turned = np.zeros(count)
    if robot.heading is not None:
        heading = states[:, robot.heading]
        paths = rotate(paths, np.broadcast_to(-heading[:-1, None], paths.shape[:2]))
        turned = np.diff(heading)
    held = [_held(time, values, edges) for time, values in r.inputs]
    inputs, uneven = np.column_stack([h[0] for h in held]), np.column_stack([h[1] for h in held]).any(1)
    near = 1e-6 * (robot.high() - robot.low())
    good = ((inputs >= robot.low() - near) & (inputs <= robot.high() + near)).all(1)
    inputs = np.clip(inputs, robot.low(), robot.high())
    pieces = []
    bounds = np.flatnonzero(np.diff(np.concatenate([[False], good, [False]]).astype(int)))
    for i, j in zip(bounds[::2], bounds[1::2], strict=True):
        if j - i > FEWEST_PERIODS:  # the first period only gives the input in force at the start
            rows = slice(i + 1, j)
            pieces.append(Trajectory(states[i + 1 : j + 1], inputs[rows], paths[rows], turned[rows], inputs[i]))
    return pieces, uneven.astype(float), int((~good).sum())


def _phase(r: _Recording, period: float) -> float:
    """Return the time in s from the begin to the first period: the phase at which most inputs change, or 0."""
    changes = np.concatenate([time[1:][np.diff(values) != 0.0] for time, values in r.inputs])
    changes = changes[(changes > r.begin) & (changes < r.end)]
    if not len(changes):
        return 0.0
    bin = period / PHASES
    phases = (changes - r.begin + 0.5 * bin) % period
    counts = np.bincount(np.minimum((phases / bin).astype(int), PHASES - 1), minlength=PHASES)
    best = int(counts.argmax())
    if counts[best] < 0.5 * len(changes):
        return 0.0
    beat = float(np.median(phases[(phases >= best * bin) & (phases < (best + 1) * bin)])) - 0.5 * bin
    return 0.0 if abs(beat) < 1e-6 * period else beat % period


def _held(time: Array, values: Array, edges: Array) -> tuple[Array, Array]:
    """Return for each period the input (its main value, else the mean) and whether it changed: (T,) each."""
    where = np.clip(np.searchsorted(time, edges, "right") - 1, 0, None)
    inputs = values[where[:-1]].copy()
    changed = np.zeros(len(inputs), dtype=bool)
    for k in np.flatnonzero(where[1:] > where[:-1]):
        first, last = where[k], where[k + 1]
        parts = np.concatenate([[edges[k]], time[first + 1 : last + 1], [edges[k + 1]]])
        lasted, held = np.diff(parts) / (edges[k + 1] - edges[k]), values[first : last + 1]
        lasted = np.bincount(np.unique(held, return_inverse=True)[1], lasted)
        levels = np.unique(held)
        most = int(lasted.argmax())
        changed[k] = lasted[most] < MOSTLY
        inputs[k] = float(levels @ lasted) if changed[k] else levels[most]
    return inputs, changed


def _split(t: Trajectory, longest: int) -> Iterator[Trajectory]:
    """Yield a trajectory in parts of about `longest` periods, because validation holds out whole trajectories."""
    count = max(round(len(t.inputs) / longest), 1)
    edges = np.linspace(0, len(t.inputs), count + 1).astype(int)
    for i, j in pairwise(edges):
        before = t.before if i == 0 else t.inputs[i - 1]
        yield Trajectory(t.states[i : j + 1], t.inputs[i:j], t.paths[i:j], t.turned[i:j], before)


# --- unobserved motion and delays --------------------------------------------------------------------------------


def _chord_deviation(robot: Robot, parts: Sequence[Trajectory], samples: int) -> float:
    """Bound in m how far a path leaves the chord between two samples, from the velocity changes over three periods.

    A velocity that changes by Δv at any time in the period leaves the chord by at most Δv·T/4. The velocity of a
    period changes by at most the sum of the second differences D of the position before and after it, divided by T:

        deviation <= max (|D_k| + |D_k+1|) / 4, divided by n² with n samples per period and the same acceleration
    """
    worst = 0.0
    for t in parts:
        D = np.linalg.norm(np.diff(t.states[:, : robot.position_dim], 2, axis=0), axis=1)
        around = np.concatenate([[0.0], D]) + np.concatenate([D, [0.0]])
        worst = max(worst, float(around.max(initial=0.0)))
    return worst / 4.0 / samples**2


def _delays(recordings: list[_Recording], robot: Robot) -> dict[str, float]:
    names = column_names(robot)[1]
    found = {}
    for i, follower in followed_inputs(robot):
        series = [(r.inputs[i], r.states[follower], r.begin, r.end) for r in recordings]
        if (seen := estimate_delay(series, robot.period)) is not None:
            found[names[i]] = seen
    return found


def _notes(robot: Robot, samples: int, chord_deviation: float, uneven: float, delays: dict[str, float]) -> list[str]:
    notes = [f"{name}: the robot responds {1e3 * d:.0f} ms later (cross-correlation)" for name, d in delays.items()]
    notes += [
        f"{name}: the delay is above one period ({robot.period:g} s), but predictions use one earlier input only. If "
        "the time stamps are wrong, shift them with --delay; otherwise choose a longer period."
        for name, d in delays.items()
        if d > robot.period
    ]
    if samples == 1:
        notes.append(
            f"the source has one position per period: between positions, paths leave their chords by at most "
            f"{1e3 * chord_deviation:.1f} mm (from the measured accelerations)"
        )
    else:
        notes.append(
            f"the source has {samples} positions per period; between them, paths leave their chords by at most "
            f"{1e3 * chord_deviation:.2f} mm"
        )
    if uneven > 0.0:
        notes.append(f"in {uneven:.0%} of the periods an input changed: the import uses its mean")
    return notes

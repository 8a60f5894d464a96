"""From columns over time to trajectories: one state a period, one input a period, cut where something is missing.

A period's state is the source's, between two samples linearly; its input is the one that was held for most of it, else
the mean. Periods begin where inputs change, if they change at one beat. A recording is cut at gaps, at jumps, and where
an input is out of the robot's bounds; angles are unwrapped first.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from brakeline.deploy.data.input_delay import estimate_delay, followed_inputs
from brakeline.deploy.data.sources.quantity_names import column_names, resolve, split
from brakeline.deploy.data.sources.source_table import Array, NoSource, Table
from brakeline.messaging.obstacle import rotate
from brakeline.messaging.robot import Robot
from brakeline.safety.model.dataset import Dataset, Trajectory

HOLD = 1.0  # s that an input counts for after its last message: then who sent it may be gone
MOSTLY = 0.9  # of a period: an input held for so long is the period's
FEWEST_PERIODS = 5  # of a trajectory that is worth keeping
LONGEST, PARTS = 300, 60  # periods of a trajectory; at least so many trajectories, to deal out
MOST_SAMPLES = 20  # of a path within a period
MISSED = 1.5  # of the usual distance of two samples: one is missing between them
BEATS = 40  # phases of the period that are told apart
LEAP = 2.0  # times the fastest motion: a jump


@dataclass(frozen=True)
class ImportReport:
    """What was made of a source, in figures and in words."""

    periods: int
    trajectories: int
    samples: int  # positions a period that the source has
    chord_deviation: float  # m, beyond them
    delays: dict[str, float]  # s, from an input to the coordinate that follows it
    uneven: float  # share of periods within which an input changed
    notes: tuple[str, ...]


@dataclass(frozen=True)
class ImportedData:
    data: Dataset
    report: ImportReport


@dataclass(frozen=True)
class _Recording:
    """One run without gaps: a series (time, values) for each state coordinate and input; from, to [s]."""

    states: list[tuple[Array, Array]]
    inputs: list[tuple[Array, Array]]
    begin: float
    end: float


def resample(
    tables: Sequence[Table], robot: Robot, chosen: dict[str, str], delay: float = 0.0, hold: float = HOLD
) -> ImportedData:
    """The data set that a source's tables hold. chosen: of `--map`; delay [s] by which inputs are stamped too early.

    Raises:
        NoSource: a column is missing, the source is too slow, or nothing is left; the message says which and why.
    """
    places = resolve(tables, robot, chosen)
    recordings, notes = _recordings(places, robot, delay, hold)
    if not recordings:
        raise NoSource("; ".join(notes) or "there is no time at which all columns have values")
    step = float(np.median(np.concatenate([np.diff(r.states[0][0]) for r in recordings])))
    samples = int(np.clip(round(robot.period / step), 1, MOST_SAMPLES))
    pieces: list[Trajectory] = []
    changed, out = [], 0
    for recording in recordings:
        made, uneven, beyond = _trajectories(recording, robot, samples)
        pieces += made
        changed.append(uneven)
        out += beyond
    if out:
        notes.append(f"{out} periods left out: an input was out of the robot's bounds")
    if not pieces:
        raise NoSource("; ".join((*notes, f"no {FEWEST_PERIODS} periods in a row are left")))
    longest = int(np.clip(sum(len(t.inputs) for t in pieces) // PARTS, 4 * robot.horizon, LONGEST))
    parts = tuple(part for t in pieces for part in _dealt(t, longest))
    chord_deviation = _between(robot, parts, samples)
    data = Dataset(robot, parts, {"origin": "import"}, chord_deviation)
    data.check()
    share = float(np.concatenate(changed).mean())
    delays = _delays(recordings, robot)
    notes += _words(robot, samples, chord_deviation, share, delays)
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
    """The spans in which no sample is missing, and how many gaps there are."""
    apart = np.diff(time)
    usual = float(np.median(apart))
    if usual > 1.05 * period:
        raise NoSource(f"{name} has a sample every {usual:.3g} s: the robot's period of {period:g} s needs one in each")
    cuts = np.flatnonzero(apart > max(MISSED * usual, 0.5 * period))
    starts, ends = np.concatenate([[0], cuts + 1]), np.concatenate([cuts, [len(time) - 1]])
    return [(float(time[i]), float(time[j])) for i, j in zip(starts, ends, strict=True)], len(cuts)


def _jumps(robot: Robot, states: list[tuple[Array, Array]]) -> list[tuple[float, float]]:
    """Between which times the pose changed more than the robot can."""
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
        most = LEAP * max(speeds["rad" if i == robot.heading else "m"], usual)
        torn = np.flatnonzero(moved > most * apart + 4.0 * robot.measurement_bound[i])
        found += [(float(time[j]), float(time[j + 1])) for j in torn]
    return sorted(set(found))


def _between_times(torn: list[tuple[float, float]]) -> list[tuple[float, float]]:
    edges = [(-np.inf, -np.inf), *torn, (np.inf, np.inf)]
    return [(a[1], b[0]) for a, b in pairwise(edges) if a[1] <= b[0]]


def _held_spans(time: Array, hold: float) -> list[tuple[float, float]]:
    """The spans in which an input is known: from a message until `hold` after the last one of them."""
    ends = np.flatnonzero(np.diff(time, append=np.inf) > hold)
    starts = np.concatenate([[0], ends[:-1] + 1])
    return [(float(time[i]), float(time[j]) + hold) for i, j in zip(starts, ends, strict=True)]


def _common(spans: list[list[tuple[float, float]]]) -> list[tuple[float, float]]:
    """The spans that lie in one of every list."""
    common = spans[0]
    for other in spans[1:]:
        met = ((max(a, c), min(b, d)) for a, b in common for c, d in _near(other, a, b))
        common = [(a, b) for a, b in met if a < b]
    return common


def _near(spans: list[tuple[float, float]], begin: float, end: float) -> Iterator[tuple[float, float]]:
    return ((c, d) for c, d in spans if c < end and d > begin)


def _within(series: tuple[Array, Array], begin: float, end: float) -> tuple[Array, Array]:
    """The samples from the last one at or before `begin` to the first one at or after `end`."""
    time, values = series
    i, j = max(int(np.searchsorted(time, begin, "right")) - 1, 0), int(np.searchsorted(time, end)) + 1
    return time[i:j], values[i:j]


# --- periods ------------------------------------------------------------------------------------------------------


def _trajectories(r: _Recording, robot: Robot, samples: int) -> tuple[list[Trajectory], Array, int]:
    """The pieces of a recording, in which periods an input changed (T,), and how many were out of bounds."""
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
        if j - i > FEWEST_PERIODS:  # the first period only tells the input in force at the start
            rows = slice(i + 1, j)
            pieces.append(Trajectory(states[i + 1 : j + 1], inputs[rows], paths[rows], turned[rows], inputs[i]))
    return pieces, uneven.astype(float), int((~good).sum())


def _phase(r: _Recording, period: float) -> float:
    """s after its begin that periods start: the beat at which inputs change, if most do so at one."""
    changes = np.concatenate([time[1:][np.diff(values) != 0.0] for time, values in r.inputs])
    changes = changes[(changes > r.begin) & (changes < r.end)]
    if not len(changes):
        return 0.0
    bin = period / BEATS
    phases = (changes - r.begin + 0.5 * bin) % period
    counts = np.bincount(np.minimum((phases / bin).astype(int), BEATS - 1), minlength=BEATS)
    best = int(counts.argmax())
    if counts[best] < 0.5 * len(changes):
        return 0.0
    beat = float(np.median(phases[(phases >= best * bin) & (phases < (best + 1) * bin)])) - 0.5 * bin
    return 0.0 if abs(beat) < 1e-6 * period else beat % period


def _held(time: Array, values: Array, edges: Array) -> tuple[Array, Array]:
    """A period's input and whether it changed within: (T,) each. One value for most of it, else the mean."""
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


def _dealt(t: Trajectory, longest: int) -> Iterator[Trajectory]:
    """A trajectory in parts of about `longest` periods: what is held out is held out in whole trajectories."""
    count = max(round(len(t.inputs) / longest), 1)
    edges = np.linspace(0, len(t.inputs), count + 1).astype(int)
    for i, j in pairwise(edges):
        before = t.before if i == 0 else t.inputs[i - 1]
        yield Trajectory(t.states[i : j + 1], t.inputs[i:j], t.paths[i:j], t.turned[i:j], before)


# --- what the source does not show --------------------------------------------------------------------------------


def _between(robot: Robot, parts: Sequence[Trajectory], samples: int) -> float:
    """m that a path may leave the chord of two samples by, from the change of velocity seen over three periods.

    A velocity that changes by Δv (wherever in the period, and at once) leaves the chord by at most Δv·T/4. What a
    period's velocity changes by is at most the sum of the second differences D of position before and after it, / T:

        bulge <= max (|D_k| + |D_k+1|) / 4,   with n samples a period, at the same acceleration:  / n²
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


def _words(robot: Robot, samples: int, chord_deviation: float, uneven: float, delays: dict[str, float]) -> list[str]:
    notes = [f"{name}: its motion follows {1e3 * d:.0f} ms later (cross-correlation)" for name, d in delays.items()]
    notes += [
        f"{name}: that is more than a period ({robot.period:g} s), and predictions know one earlier input only: shift "
        "it with --delay if the stamps are wrong, else choose a longer period"
        for name, d in delays.items()
        if d > robot.period
    ]
    if samples == 1:
        notes.append(
            f"the source has one position a period: how far paths leave their chords in between is bounded from the "
            f"periods' ends and the acceleration seen, by {1e3 * chord_deviation:.1f} mm"
        )
    else:
        notes.append(
            f"paths within a period from {samples} positions, {1e3 * chord_deviation:.2f} mm more between them"
        )
    if uneven > 0.0:
        notes.append(f"in {uneven:.0%} of the periods an input changed within: its mean counts")
    return notes

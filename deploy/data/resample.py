"""Resample columns over time to trajectories with one state and one input per period.

States are interpolated linearly, but extrapolated from before a change of an input (`_at_edges`). The input of a period
is the one that was held for most of it, or else the mean.
Periods begin where inputs change, if most inputs change at a common phase. A recording is split at gaps, at jumps of
the pose, and where an input is outside the robot's bounds. Angles are unwrapped first.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from brakeline.deploy.data.beat import find_beat
from brakeline.deploy.data.gap_free_recordings import GAP, GapFreeRecording, gap_free_recordings
from brakeline.deploy.data.glitches import MOST as MOST_GLITCHES
from brakeline.deploy.data.glitches import without_glitches
from brakeline.deploy.data.held_values import without_held_poses
from brakeline.deploy.data.input_response import estimate_delay, followed_inputs
from brakeline.deploy.data.log_options import LogOptions
from brakeline.deploy.data.motion_sense import motion_notes
from brakeline.deploy.data.response_check import checked_responses
from brakeline.deploy.data.sources.quantity_names import choice_notes, column_names, column_units, resolve
from brakeline.deploy.data.sources.source_table import Array, Series, Table, notes_of
from brakeline.deploy.data.standing_noise import small_errors
from brakeline.deploy.data.unit_table import AS_IT_IS, unit_option
from brakeline.errors import BadData, NoSource
from brakeline.messaging.obstacle import rotate
from brakeline.messaging.robot import Robot
from brakeline.safety.model.dataset import Dataset, Trajectory, bends

HOLD = 1.0  # s for which an input is valid after its last message: later its sender may be gone
MOSTLY = 0.9  # share of a period: an input held for longer is the period's input
FEWEST_PERIODS = 5  # shorter trajectories are dropped
LONGEST, FEWEST_PARTS = 300, 60  # periods per trajectory; number of trajectories, so that 30 % can be held out
MAX_SAMPLES = 20  # positions per period
FAR = 10.0  # times an input's larger bound
SAME = 1e-6  # s: closer times are the same, but for rounding
LIKE_A_BEAT = 0.9  # share of the times between changes that are multiples of a beat
SAME_BEAT = 0.005  # of the period: jitter of the stamps moves the beat that a log shows by as much
NEAR_MULTIPLE = 0.05  # of a beat: how far from a multiple of it the period counts as one
PHASES = 40  # bins of the phase at which inputs change


@dataclass(frozen=True)
class ImportReport:
    """Figures of an import, and notes for the user."""

    periods: int
    trajectories: int
    samples: int  # positions per period in the source
    chord_deviation: float  # m, of the path between two positions; in joint space, see `Dataset`
    delays: dict[str, float]  # s, for each input, to the coordinate that follows it
    uneven: float  # share of the periods in which an input changed
    notes: tuple[str, ...]


@dataclass(frozen=True)
class ImportedData:
    """A data set and the report of its import."""

    data: Dataset
    report: ImportReport


def resample(
    tables: Sequence[Table], robot: Robot, options: LogOptions, delay: float = 0.0, hold: float = HOLD
) -> ImportedData:
    """Resample the tables of a source to a data set.

    Args:
        robot: its description gives period, columns and bounds.
        options: where the columns are in the source, and in which units.
        delay: time in s by which the stamps of the inputs are too early.
        hold: time in s for which an input is valid after its last message.

    Raises:
        NoSource: a column is missing, the source has too few samples, or no trajectory is left; the message gives the
            reason.
    """
    states, inputs = column_names(robot)
    positions, heading = states[: robot.position_dim], "" if robot.heading is None else states[robot.heading]
    places = resolve(tables, robot, options)
    chosen = choice_notes(tables, places)
    bounds = dict(zip(inputs, zip(robot.action_low, robot.action_high, strict=True), strict=True))
    places, glitches = without_glitches(places, positions, heading, bounds)
    places, held = without_held_poses(places, positions, heading, states)
    units = column_units(robot)
    seen = motion_notes(places, positions, inputs, heading, units, options.units) if robot.position_dim else []
    recordings, cuts = gap_free_recordings(places, robot, delay, hold)
    notes = [*notes_of(tables), *chosen, *glitches, *held, *seen, *cuts]
    if not recordings:
        raise NoSource("; ".join(notes) or "the columns have no time in common")
    responses = checked_responses(recordings, robot, delay, options.units)
    _refuse_far_inputs(recordings, robot, options)
    step = max(_usual_step([r.states[i] for r in recordings]) for i in range(robot.path_dim))
    samples = int(np.clip(round(robot.period / step), 1, MAX_SAMPLES))
    resampled = [_trajectories(recording, robot, samples) for recording in recordings]
    pieces = [t for trajectories, _, _ in resampled for t in trajectories]
    if out := sum(beyond for _, _, beyond in resampled):
        notes.append(f"{out} periods left out: an input was outside the robot's bounds ({_beyond(recordings, robot)})")
    if not pieces:
        raise NoSource("; ".join((*notes, f"fewer than {FEWEST_PERIODS} consecutive periods are left")))
    longest = int(np.clip(sum(len(t.inputs) for t in pieces) // FEWEST_PARTS, 4 * robot.horizon, LONGEST))
    parts = tuple(part for t in pieces for part in _split(t, longest))
    chord_deviation = _chord_deviation(robot, parts, samples)
    data = Dataset(robot, parts, {"origin": "import"}, chord_deviation)
    try:
        data.check()
    except BadData as error:
        raise NoSource(
            f"{error} If not: there is a position every {step:.3g} s, which does not show where the robot is when an "
            "input changes. Log the state more often, or at the moments when the inputs change"
        ) from error
    uneven = float(np.concatenate([changed for _, changed, _ in resampled]).mean())
    delays = _delays(recordings, robot)
    notes += small_errors(robot, parts)
    notes += _beat_notes(recordings, robot, uneven, max(delays.values(), default=0.0))
    notes += [*_notes(robot, samples, chord_deviation, uneven, delays), *responses]
    return ImportedData(
        data, ImportReport(data.periods, len(parts), samples, chord_deviation, delays, uneven, tuple(notes))
    )


def _usual_step(parts: Sequence[Series]) -> float:
    """Return the usual time in s between two samples of a coordinate.

    It is the median, unless more than a tenth of the recorded time has far fewer samples. Rows in pairs and the rows
    of a fast part are many, so they would decide about the median.
    """
    apart = np.sort(np.concatenate([np.diff(time) for time, _ in parts]))
    lasted = np.cumsum(apart)
    usual, slow = float(np.median(apart)), float(apart[np.searchsorted(lasted, MOSTLY * lasted[-1])])
    return slow if slow > GAP * usual else usual


def _trajectories(r: GapFreeRecording, robot: Robot, samples: int) -> tuple[list[Trajectory], Array, int]:
    """Return trajectories, a flag (T,) for each period in which an input changed, and how many were out of bounds."""
    period = robot.period
    begin = r.begin + _phase(r, period)
    count = int(np.floor((r.end - begin) / period + 1e-6))
    if count < 1:
        return [], np.zeros(0), 0
    edges: Array = np.asarray(begin + period * np.arange(count + 1), float)
    changes = np.unique(np.concatenate([time[1:][np.diff(values) != 0.0] for time, values in r.inputs]))
    states = np.column_stack([_at_edges(edges, time, values, changes) for time, values in r.states])
    fine: Array = np.asarray(begin + period / samples * np.arange(count * samples + 1), float)
    d = robot.path_dim
    at = np.column_stack([np.interp(fine, time, values) for time, values in r.states[:d]])
    paths = at[1:].reshape(count, samples, d) - at[:-1:samples, None]
    turned, headings = np.zeros(count), None
    if robot.heading is not None:
        time, values = r.states[robot.heading]
        fine_heading = np.interp(fine, time, values)
        headings = fine_heading[1:].reshape(count, samples) - fine_heading[:-1:samples, None]
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
            within = None if headings is None else headings[rows]
            pieces.append(Trajectory(states[i + 1 : j + 1], inputs[rows], paths[rows], turned[rows], inputs[i], within))
    return pieces, uneven.astype(float), int((~good).sum())


def _at_edges(edges: Array, time: Array, values: Array, changes: Array) -> Array:
    """Return the values (T,) at the edges of periods, from the samples around each edge.

    If an input changes between these samples, the later one shows what the new input did. So the state at the start of
    a period would contain its input, which no measurement at that time does. Such an edge has the values that the two
    samples before it predict.

    Args:
        edges (T,), time (S,), changes (C,): times in s; of the samples, and of the changes of any input.
        values (S,): samples.
    """
    at_edges = np.interp(edges, time, values)
    if len(time) < 3:
        return at_edges
    last = np.clip(np.searchsorted(time, edges, "right") - 1, 1, len(time) - 2)
    between = np.searchsorted(changes, time[last + 1] - SAME) > np.searchsorted(changes, time[last] + SAME)
    late = np.flatnonzero(between & (edges > time[last] + SAME) & (edges < time[last + 1] - SAME))
    at = last[late]
    slope = (values[at] - values[at - 1]) / (time[at] - time[at - 1])
    at_edges[late] = values[at] + slope * (edges[late] - time[at])
    return at_edges


def _phase(r: GapFreeRecording, period: float) -> float:
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
        levels, level = np.unique(values[first : last + 1], return_inverse=True)
        lasted = np.bincount(level, np.diff(parts) / (edges[k + 1] - edges[k]))
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
        within = None if t.headings is None else t.headings[i:j]
        yield Trajectory(t.states[i : j + 1], t.inputs[i:j], t.paths[i:j], t.turned[i:j], before, within)


def _chord_deviation(robot: Robot, parts: Sequence[Trajectory], samples: int) -> float:
    """Bound in m how far a path leaves the chord between two samples, from the velocity changes over three periods.

    A velocity that changes by Δv at any time in the period leaves the chord by at most Δv·T/4. The velocity of a
    period changes by at most the sum of the second differences D of the position before and after it, divided by T:

        deviation <= max (|D_k| + |D_k+1|) / 4, divided by n² with n samples per period and the same acceleration

    In joint space the same holds for the value of each limit, in units of `Robot.limit_scales`.
    """
    worst = 0.0
    for t in parts:
        D = bends(robot, t.states)
        around = np.concatenate([[0.0], D]) + np.concatenate([D, [0.0]])
        worst = max(worst, float(around.max(initial=0.0)))
    return worst / 4.0 / samples**2


def _refuse_far_inputs(recordings: Sequence[GapFreeRecording], robot: Robot, options: LogOptions) -> None:
    """Raise NoSource if an input often is so far beyond its bounds that it must be in another unit, such as percent.

    Its smallest values are within the bounds. They would be taken for large ones.
    """
    for i, name in enumerate(column_names(robot)[1]):
        values = np.concatenate([r.inputs[i][1] for r in recordings])
        most = max(abs(float(robot.low()[i])), abs(float(robot.high()[i])))
        if np.quantile(np.abs(values), 1.0 - MOST_GLITCHES) > FAR * most and options.units.get(name) != AS_IT_IS:
            raise NoSource(
                f"{_beyond(recordings, robot)}: {name} is in another unit than the description's. Convert it (--unit), "
                f"correct the bounds, or take the column as it is with {unit_option(name, AS_IT_IS)}"
            )


def _beyond(recordings: Sequence[GapFreeRecording], robot: Robot) -> str:
    """Return the ranges of the inputs that leave their bounds, with the bounds."""
    ranges = []
    for i, name in enumerate(column_names(robot)[1]):
        values = np.concatenate([r.inputs[i][1] for r in recordings])
        low, high = float(robot.low()[i]), float(robot.high()[i])
        if values.min() < low or values.max() > high:
            ranges.append(f"{name} {values.min():.3g} to {values.max():.3g}, bounds {low:g} to {high:g}")
    return "; ".join(ranges)


def _beat_notes(recordings: Sequence[GapFreeRecording], robot: Robot, uneven: float, delay: float) -> list[str]:
    """Return a note if the inputs change at multiples of another time than the period, or within many periods.

    The note proposes no period below the largest delay [s], because predictions use one earlier input only.
    """
    between = [
        np.diff(np.unique(np.concatenate([time[1:][np.diff(v) != 0.0] for time, v in r.inputs]))) for r in recordings
    ]
    step = float(np.median(np.concatenate([np.diff(time) for r in recordings for time, _ in r.inputs])))
    beat = find_beat(np.concatenate(between), step)
    if beat is None or beat.share < LIKE_A_BEAT:
        return []
    ratio = robot.period / beat.seconds
    if abs(ratio - 1.0) < SAME_BEAT:
        return []
    if abs(ratio - round(ratio)) < NEAR_MULTIPLE and ratio > 0.5 and uneven < 1.0 - MOSTLY:
        return []
    seen = (
        f"the inputs change at multiples of {beat.seconds:.3g} s, but the description's period is {robot.period:g} s: "
    )
    if delay > beat.seconds and ratio > 1.0:
        return [
            f"{seen}keep that period, because the delay is longer than {beat.seconds:.3g} s. If you can, let your "
            f"controller hold each input for {robot.period:g} s, and record again"
        ]
    return [f"{seen}if your controller sends inputs every {beat.seconds:.3g} s, write `period = {beat.seconds:.3g}`"]


def _delays(recordings: list[GapFreeRecording], robot: Robot) -> dict[str, float]:
    names = column_names(robot)[1]
    delays = {}
    for i, follower in followed_inputs(robot):
        series = [(r.inputs[i], r.states[follower], r.begin, r.end) for r in recordings]
        if (seen := estimate_delay(series, robot.period)) is not None:
            delays[names[i]] = seen
    return delays


def _notes(robot: Robot, samples: int, chord_deviation: float, uneven: float, delays: dict[str, float]) -> list[str]:
    notes = [f"{name}: the robot responds {1e3 * d:.0f} ms later (cross-correlation)" for name, d in delays.items()]
    notes += [
        f"{name}: the delay is above one period ({robot.period:g} s), but predictions use one earlier input only. If "
        f"`certify` finds wide sets, choose a longer period. --delay {d:.3g} is only for wrong time stamps: if the "
        "robot itself responds late, the filter would then expect it to respond at once."
        for name, d in delays.items()
        if d > 1.01 * robot.period
    ]
    most = f"paths leave their chords by at most {1e3 * chord_deviation:.{1 if samples == 1 else 2}f} mm"
    if not robot.position_dim:
        notes.append(
            f"the source has {samples} states per period; between them, a limit is exceeded by at most "
            f"{chord_deviation:.2%} of its range"
        )
    elif samples == 1:
        notes.append(
            f"the source has one position per period: between positions, {most} (from the measured accelerations)"
        )
    else:
        notes.append(f"the source has {samples} positions per period; between them, {most}")
    if uneven > 0.0:
        notes.append(f"in {uneven:.0%} of the periods an input changed: the import uses its mean")
    return notes

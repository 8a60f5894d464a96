"""Infer a robot description from a log: states, inputs, units, period, ranges and delays.

Messages define their quantities (`sources/quantity_names.py`). In a file of columns, positions and inputs are found by
name. The role and the unit of any other column follow from its correlation with the motion.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from brakeline.deploy.data.input_delay import estimate_delay
from brakeline.deploy.data.sources.quantity_names import AXES, COMMAND
from brakeline.deploy.data.sources.source_table import Array, Table
from brakeline.errors import NoSource

Indices = NDArray[np.signedinteger]

POSITION = re.compile(r"(?:pos(?:ition)?[ _.]?|p)?([xyz])(?:[ _.]?pos(?:ition)?)?", re.IGNORECASE)
HEADING = re.compile(r"heading|yaw|theta|psi", re.IGNORECASE)
INPUT = re.compile(rf"(?:{COMMAND}|cmd|input|set(?:point)?|target)(?![a-z])", re.IGNORECASE)
# For each quantity of a message: its name in a description, and its unit.
STATES = {"body.x": ("speed", "m/s"), "body.y": ("speed aside", "m/s"), "yaw rate": ("turn rate", "rad/s")}
FLYING = {f"velocity.{axis}": (f"v{axis}", "m/s") for axis in AXES}
SPACE = FLYING | {f"acceleration.{axis}": (f"a{axis}", "m/s2") for axis in AXES}
INPUTS = STATES | {"steering": ("steering", "rad"), "acceleration": ("acceleration", "m/s2")}
HELD = 0.5  # share of rows that repeat the row before: only inputs, which are held, repeat this often
SPAN = 0.3  # s over which motion is compared with a column: over less, noise dominates
SAME_CORRELATION = 0.9  # of two columns of the same quantity
SAME_GAIN = (0.75, 1.33)  # ratio of their standard deviations
FOLLOWS_CORRELATION = 0.6  # of an input with the coordinate that follows it
MAX_LAG = 1.0  # s
FEWEST_SPANS = 20  # fewer spans give no result


@dataclass(frozen=True)
class InferredColumn:
    """A column of the log, as a state coordinate or an input. `unit` is empty if it is unknown."""

    name: str
    unit: str
    least: float
    most: float
    role: str = "other"
    follows: str = ""  # a coordinate: name of the input that it follows
    change: float = 0.0  # per period; an input: its largest change; a coordinate: its fastest braking
    delay: float | None = None  # s; a coordinate: delay from the input
    moves: bool | None = None  # an input: whether it moves the position; None: unknown


@dataclass(frozen=True)
class InferredSchema:
    """The parts of a robot description that a log shows. `notes` says what it does not show, and why."""

    period: float  # s: median time between two changes of an input, or between two rows if there is no input
    states: tuple[InferredColumn, ...]  # in the order of a description
    inputs: tuple[InferredColumn, ...]
    notes: tuple[str, ...]


@dataclass
class _Rows:
    """One run, resampled to the time stamps of its positions: time (T,) in s, each column (T,)."""

    time: Array
    columns: dict[str, Array]


@dataclass
class _Log:
    """All runs of a log, and the roles of its columns."""

    runs: list[_Rows]
    positions: list[str]  # names of the position columns
    inputs: list[str]
    period: float
    heading: str = ""
    units: dict[str, str] = field(default_factory=dict)

    def values(self, name: str) -> Array:
        """Return a column over all runs."""
        return np.concatenate([run.columns[name] for run in self.runs])

    def spans(self, seconds: float) -> Iterator[tuple[_Rows, Indices, Indices]]:
        """Yield for each run the row indices i and j of all spans of about `seconds` without a missing row."""
        for run in self.runs:
            n = max(round(seconds / float(np.median(np.diff(run.time)))), 1)
            i = np.arange(0, len(run.time) - n)
            whole = run.time[i + n] - run.time[i] < 1.5 * n * np.median(np.diff(run.time))
            yield run, i[whole], i[whole] + n


def infer_schema(tables: Sequence[Table]) -> InferredSchema:
    """Infer the schema of a log.

    Raises:
        NoSource: the log has fewer than two position columns; the message gives the expected names.
    """
    notes: list[str] = []
    log = _from_messages(tables) if tables[0].name else _from_columns(tables[0])
    for name in [n for n in (*log.runs[0].columns,) if np.ptp(log.values(n)) == 0.0]:
        notes.append(f"{name} never changes, so that it is left out")
        for names in (log.positions, log.inputs):
            if name in names:
                names.remove(name)
        for run in log.runs:
            del run.columns[name]
    if len(log.positions) < 2:
        raise NoSource(
            f"the log needs two position columns ({', '.join(AXES)}) that change: {'; '.join(notes) or 'none'}"
        )
    if not tables[0].name:
        _read_motion(log, notes)
    others = [n for n in log.runs[0].columns if n not in (*log.positions, log.heading, *log.inputs)]
    pairs, delays = _followers(log, others)
    for name, follower in pairs.items():
        log.units.setdefault(name, log.units.get(follower, ""))
    by_follower = {follower: name for name, follower in pairs.items()}
    states = [_column(log, name, role="position", unit="m") for name in log.positions]
    states += [_column(log, log.heading, role="heading", unit="rad")] if log.heading else []
    states += [
        _column(log, n, follows=_plain(by_follower.get(n, ""), log), change=_braking(log, n), delay=delays.get(n))
        for n in others
    ]
    inputs = [_column(log, n, name=_plain(n, log), change=_slew(log, n), moves=_moves(log, n)) for n in log.inputs]
    if not inputs:
        notes.append(f"no column is clearly an input: name inputs `{COMMAND} NAME`, or log them as held values")
    return InferredSchema(float(f"{log.period:.3g}"), tuple(states), tuple(inputs), tuple(notes))


def _column(log: _Log, column: str, name: str = "", unit: str = "", **more: object) -> InferredColumn:
    values = log.values(column)
    unit = unit or log.units.get(column, "")
    return InferredColumn(name or column, unit, float(values.min()), float(values.max()), **more)  # type: ignore[arg-type]


def _plain(name: str, log: _Log) -> str:
    """Return an input's name in the description: `command NAME` is NAME if a coordinate has that name too."""
    short = name.removeprefix(f"{COMMAND} ")
    return short if short in log.runs[0].columns and short not in log.inputs else name


# --- from tables to rows ------------------------------------------------------------------------------------------


def _from_messages(tables: Sequence[Table]) -> _Log:
    def field_of(quantity: str) -> tuple[Table, str] | None:
        candidates = [t for t in tables if quantity in t.columns]
        return (min(candidates, key=lambda t: t.rank), quantity) if candidates else None

    places = {axis: field_of(f"position.{axis}") for axis in AXES}
    flat = (up := places["z"]) is None or float(np.nanstd(up[0].columns[up[1]])) < 1e-3
    kinds = {q: (*named, field_of(q)) for q, named in (STATES if flat else SPACE).items()}
    input_names = INPUTS if flat else FLYING
    commands = {q: (*named, field_of(f"{COMMAND}.{q}")) for q, named in input_names.items()}
    fields = {axis: place for axis, place in places.items() if place is not None and (axis != "z" or not flat)}
    if len(fields) < 2:
        available = "; ".join(f"{t.name}: {', '.join(t.columns)}" for t in tables)
        raise NoSource(f"no message holds positions (Odometry, PoseStamped, TF). The source has: {available}")
    yaw = field_of("yaw") if flat else None
    units = {name: unit for name, unit, place in kinds.values() if place is not None}
    fields |= {"heading": yaw} if yaw is not None else {}
    fields |= {name: place for name, _, place in kinds.values() if place is not None}
    inputs = []
    for name, unit, place in commands.values():
        if place is not None:
            full = f"{COMMAND} {name}"
            fields[full], units[full] = place, unit
            inputs.append(full)
    runs = _runs(fields, inputs)
    heading = "heading" if yaw is not None else ""
    for run in runs if heading else ():
        run.columns[heading] = np.unwrap(run.columns[heading])
    return _Log(runs, [axis for axis in AXES if axis in fields], inputs, _command_period(runs, inputs), heading, units)


def _from_columns(table: Table) -> _Log:
    axes = {match[1].lower(): name for name in table.columns if (match := POSITION.fullmatch(name.strip()))}
    if not {"x", "y"} <= axes.keys():
        raise NoSource(f"the position columns `x` and `y` are missing; the columns are: {', '.join(table.columns)}")
    places = [axes[axis] for axis in AXES if axis in axes]
    used = {name: (table, name) for name in table.columns if np.isfinite(table.columns[name]).any()}
    inputs = [name for name in used if INPUT.match(name)]
    if not inputs:
        repeated = {n: float(np.mean(np.diff(c[np.isfinite(c)]) == 0.0)) for n, c in table.columns.items() if n in used}
        inputs = [n for n, share in repeated.items() if share >= HELD and n not in places]
    runs = _runs(used, inputs)
    return _Log(runs, places, inputs, _command_period(runs, inputs))


def _command_period(runs: Sequence[_Rows], inputs: Sequence[str]) -> float:
    """Return the median time in s between two changes of an input, or between two rows if there is none."""
    changed = [np.any([np.diff(run.columns[name]) != 0.0 for name in inputs], axis=0) for run in runs if inputs]
    between = [np.diff(run.time[1:][at]) for run, at in zip(runs, changed, strict=False)]
    usual = _row_period(runs[0].time)
    return max(float(np.median(np.concatenate(between))), usual) if sum(map(len, between)) else usual


def _row_period(time: Array) -> float:
    return float(np.median(np.diff(time)))


def _runs(fields: dict[str, tuple[Table, str]], inputs: Sequence[str]) -> list[_Rows]:
    """Resample all columns to the time stamps of the first one: states linearly, inputs held."""
    first = next(iter(fields.values()))[0]
    runs = []
    for run in np.unique(first.run) if len(first.run) else [0]:
        series = {name: table.series(column, int(run)) for name, (table, column) in fields.items()}
        if any(len(time) < 2 for time, _ in series.values()):
            continue
        begin, end = max(t[0] for t, _ in series.values()), min(t[-1] for t, _ in series.values())
        clock = next(iter(series.values()))[0]
        clock = clock[(clock >= begin) & (clock <= end)]
        if len(clock) < FEWEST_SPANS:
            continue
        columns = {}
        for name, (time, values) in series.items():
            if name in inputs:
                columns[name] = values[np.searchsorted(time, clock + 1e-9, "right") - 1]
            else:
                columns[name] = np.interp(clock, time, values)
        runs.append(_Rows(clock, columns))
    if not runs:
        raise NoSource(f"fewer than {FEWEST_SPANS} rows have values in all columns")
    return runs


# --- roles and units from the motion -------------------------------------------------------------------------------


def _read_motion(log: _Log, notes: list[str]) -> None:
    """Find the heading, and the units of the columns that measure speeds."""
    flat = len(log.positions) == 2
    candidates = [n for n in log.runs[0].columns if n not in (*log.positions, *log.inputs)]
    if flat:
        scores = {n: _heading_score(log, n) for n in candidates}
        named = [n for n in candidates if HEADING.fullmatch(n.strip())]
        best = max(scores, key=lambda n: scores[n], default="")
        if best and scores[best] > SAME_CORRELATION:
            log.heading = best
        elif named:
            log.heading = named[0]
            notes.append(f"{named[0]} is taken as the heading by its name: the motion does not confirm it")
        else:
            notes.append(
                "no column is clearly the heading: none agrees with the motion, and none is named heading or yaw"
            )
    for run in log.runs if log.heading else ():
        run.columns[log.heading] = np.unwrap(run.columns[log.heading])
    speeds = _speeds(log)
    for name in candidates:
        if name == log.heading:
            continue
        for unit, measured in speeds:
            if _same_quantity(measured, _span_means(log, name)):
                log.units[name] = unit
                break


def _heading_score(log: _Log, name: str) -> float:
    """Return how well a column agrees with the direction of motion: the mean of |cos(direction - angle)|, in [0, 1]."""
    cosines = []
    for run, i, j in log.spans(SPAN):
        way = np.stack([run.columns[p][j] - run.columns[p][i] for p in log.positions])
        length = np.hypot(*way)
        far = length > 0.3 * length.max(initial=0.0)
        angle = run.columns[name][(i + j) // 2]
        cosines.append((np.abs(np.cos(np.arctan2(way[1], way[0]) - angle)) * far)[far])
    values = np.concatenate(cosines)
    # On a straight path a constant agrees as well as the heading does: require that the angle changes.
    turned = np.ptp(log.values(name)) > 0.5
    return float(values.mean()) if turned and len(values) >= FEWEST_SPANS else 0.0


def _speeds(log: _Log) -> list[tuple[str, Array]]:
    """Return (unit, mean speed in each span): along and across the heading and around it, or along the axes."""
    speeds: dict[str, list[Array]] = {}
    for run, i, j in log.spans(SPAN):
        time = run.time[j] - run.time[i]
        way = [(run.columns[p][j] - run.columns[p][i]) / time for p in log.positions]
        if log.heading:
            middle = run.columns[log.heading][(i + j) // 2]
            turned = (run.columns[log.heading][j] - run.columns[log.heading][i]) / time
            cos, sin = np.cos(middle), np.sin(middle)
            way = [cos * way[0] + sin * way[1], cos * way[1] - sin * way[0], turned]
        for k, part in enumerate(way):
            speeds.setdefault("rad/s" if log.heading and k == 2 else f"m/s {k}", []).append(part)
    return [(unit.split(" ")[0], np.concatenate(parts)) for unit, parts in speeds.items()]


def _span_means(log: _Log, name: str) -> Array:
    """Return a column's mean in each span."""
    means = []
    for run, i, j in log.spans(SPAN):
        sums = np.concatenate([[0.0], np.cumsum(run.columns[name])])
        means.append((sums[j + 1] - sums[i]) / (j - i + 1))
    return np.concatenate(means)


def _same_quantity(one: Array, other: Array, correlation: float = SAME_CORRELATION) -> bool:
    """Return whether two series correlate more than `correlation`, with a gain of about 1."""
    if len(one) < FEWEST_SPANS or np.ptp(one) == 0.0 or np.ptp(other) == 0.0:
        return False
    slope = float(np.std(other) / np.std(one))
    return float(np.corrcoef(one, other)[0, 1]) > correlation and SAME_GAIN[0] < slope < SAME_GAIN[1]


def _followers(log: _Log, others: Sequence[str]) -> tuple[dict[str, str], dict[str, float]]:
    """Return for each input the coordinate that follows it, and for each such coordinate the delay in s."""
    fits: list[tuple[float, str, str]] = []
    for name in log.inputs:
        for other in others:
            if log.units.get(name) and log.units.get(other) and log.units[name] != log.units[other]:
                continue
            fits.append((_lagged_correlation(log, name, other), name, other))
    # NAME follows `command NAME` by definition, however slowly.
    named = {name: name.removeprefix(f"{COMMAND} ") for name in log.inputs}
    pairs = {name: other for name, other in named.items() if other in others}
    for score, name, other in sorted(fits, reverse=True):
        if score > FOLLOWS_CORRELATION and name not in pairs and other not in pairs.values():
            pairs[name] = other
    delays = {}
    for name, other in pairs.items():
        series = [
            ((r.time, r.columns[name]), (r.time, r.columns[other]), float(r.time[0]), float(r.time[-1]))
            for r in log.runs
        ]
        if (delay := estimate_delay(series, log.period)) is not None:
            delays[other] = delay
    return pairs, delays


def _lagged_correlation(log: _Log, name: str, other: str) -> float:
    """Return the best correlation of an input with a coordinate up to `MAX_LAG` later; 0 if the gain is not near 1."""
    best = 0.0
    for late in np.arange(0.0, MAX_LAG, max(_row_period(log.runs[0].time), log.period / 4.0)):
        n = round(late / _row_period(log.runs[0].time))
        command = np.concatenate([r.columns[name][: len(r.time) - n] for r in log.runs if len(r.time) > n])
        response = np.concatenate([r.columns[other][n:] for r in log.runs if len(r.time) > n])
        if _same_quantity(command, response, best):
            best = float(np.corrcoef(command, response)[0, 1])
    return best


def _slew(log: _Log, name: str) -> float:
    """Return the largest change of an input over one period."""
    return max(float(np.abs(run.columns[name][j] - run.columns[name][i]).max()) for run, i, j in log.spans(log.period))


def _braking(log: _Log, name: str) -> float:
    """Return the 95 % quantile of the decrease of a coordinate's magnitude per period, without noise."""
    falls = [np.abs(run.columns[name][i]) - np.abs(run.columns[name][j]) for run, i, j in log.spans(log.period)]
    decrease = np.concatenate(falls)
    decrease = decrease[decrease > 0.02 * np.abs(log.values(name)).max()]
    return float(np.quantile(decrease, 0.95)) if len(decrease) >= FEWEST_SPANS else 0.0


def _moves(log: _Log, name: str) -> bool | None:
    """Return whether the input moves the robot while all others are zero; None if that was never recorded."""
    alone, driving = [], []
    seconds = max(2.0 * log.period, SPAN)
    for run, i, j in log.spans(seconds):
        way = np.linalg.norm([run.columns[p][j] - run.columns[p][i] for p in log.positions], axis=0)
        small = [np.abs(run.columns[n]) <= 0.05 * np.abs(log.values(n)).max() for n in log.inputs if n != name]
        large = np.abs(run.columns[name]) > 0.2 * np.abs(log.values(name)).max()
        calm = np.concatenate([[0], np.cumsum(large & np.all(small, axis=0) if small else large)])
        before = np.maximum(i - (j - i), 0)  # and for as long before, so that earlier motion has ended
        isolated = calm[j + 1] - calm[before] == j + 1 - before
        alone.append(way[isolated])
        driving.append(way)
    ways = np.concatenate(alone)
    if len(ways) < FEWEST_SPANS:
        return None
    return bool(np.quantile(ways, 0.5) > 0.1 * np.quantile(np.concatenate(driving), 0.9))

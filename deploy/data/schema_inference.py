"""What a log tells of a robot that has no description yet: which column is what, how often, how far, how late.

Messages say what they are (`sources/quantities.py`). Of a file of columns names say what is a position and what an
input; what else a column is, is seen by how the position moves.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from brakeline.deploy.data.input_delay import estimate_delay
from brakeline.deploy.data.sources.quantity_names import AXES, COMMAND
from brakeline.deploy.data.sources.source_table import Array, NoSource, Table

Indices = NDArray[np.signedinteger]

POSITION = re.compile(r"(?:pos(?:ition)?[ _.]?|p)?([xyz])(?:[ _.]?pos(?:ition)?)?", re.IGNORECASE)
HEADING = re.compile(r"heading|yaw|theta|psi", re.IGNORECASE)
INPUT = re.compile(rf"(?:{COMMAND}|cmd|input|set(?:point)?|target)(?![a-z])", re.IGNORECASE)
# Of a message's quantity: the name that a description gives it, and its unit.
STATES = {"body.x": ("speed", "m/s"), "body.y": ("speed aside", "m/s"), "yaw rate": ("turn rate", "rad/s")}
FLYING = {f"velocity.{axis}": (f"v{axis}", "m/s") for axis in AXES}
SPACE = FLYING | {f"acceleration.{axis}": (f"a{axis}", "m/s2") for axis in AXES}
INPUTS = STATES | {"steering": ("steering", "rad"), "acceleration": ("acceleration", "m/s2")}
HELD = 0.5  # share of rows with the value of the row before: so often only inputs that are held repeat
SPAN = 0.3  # s over which motion is compared with a column: measurements differ by noise over less
ALIKE = 0.9  # correlation of two columns that show the same
GAIN = (0.75, 1.33)  # of the one by the other
FOLLOWS = 0.6  # correlation of an input with what follows it
MOST_LAG = 1.0  # s
FEW = 20  # spans: of fewer nothing is told


@dataclass(frozen=True)
class Column:
    """unit: empty if it can't be told. follows: the input that it comes to."""

    name: str
    unit: str
    least: float
    most: float
    role: str = "other"
    follows: str = ""
    change: float = 0.0  # an input's largest from one period to the next; a coordinate's fastest braking, a period
    delay: float | None = None  # s from the input to it
    moves: bool | None = None  # an input: does it move the position? None: can't be told


@dataclass(frozen=True)
class InferredSchema:
    period: float  # s: the median time between two changes of an input; without any, between two rows
    states: tuple[Column, ...]  # in a description's order
    inputs: tuple[Column, ...]
    notes: tuple[str, ...]  # what can't be told, and why


@dataclass
class _Rows:
    """One run on the clock of its positions: columns (T,) each."""

    time: Array
    columns: dict[str, Array]


@dataclass
class _Log:
    runs: list[_Rows]
    places: list[str]  # of the position
    inputs: list[str]
    period: float
    heading: str = ""
    units: dict[str, str] = field(default_factory=dict)

    def all(self, name: str) -> Array:
        return np.concatenate([run.columns[name] for run in self.runs])

    def spans(self, seconds: float) -> Iterator[tuple[_Rows, Indices, Indices]]:
        """Of each run the rows i and j, about so far apart, between which none is missing."""
        for run in self.runs:
            n = max(round(seconds / float(np.median(np.diff(run.time)))), 1)
            i = np.arange(0, len(run.time) - n)
            whole = run.time[i + n] - run.time[i] < 1.5 * n * np.median(np.diff(run.time))
            yield run, i[whole], i[whole] + n


def infer_schema(tables: Sequence[Table]) -> InferredSchema:
    """
    Raises:
        NoSource: no two positions are found; the message says by which names they would be.
    """
    notes: list[str] = []
    log = _from_messages(tables) if tables[0].name else _from_columns(tables[0])
    for name in [n for n in (*log.runs[0].columns,) if np.ptp(log.all(n)) == 0.0]:
        notes.append(f"{name} never changes: left out")
        for names in (log.places, log.inputs):
            if name in names:
                names.remove(name)
        for run in log.runs:
            del run.columns[name]
    if len(log.places) < 2:
        raise NoSource(f"no two columns of a position ({', '.join(AXES)}) that changes: {'; '.join(notes) or 'none'}")
    if not tables[0].name:
        _read_motion(log, notes)
    others = [n for n in log.runs[0].columns if n not in (*log.places, log.heading, *log.inputs)]
    pairs, delays = _followers(log, others)
    for name, follower in pairs.items():
        log.units.setdefault(name, log.units.get(follower, ""))
    by_follower = {follower: name for name, follower in pairs.items()}
    states = [_column(log, name, role="position", unit="m") for name in log.places]
    states += [_column(log, log.heading, role="heading", unit="rad")] if log.heading else []
    states += [
        _column(log, n, follows=_plain(by_follower.get(n, ""), log), change=_braking(log, n), delay=delays.get(n))
        for n in others
    ]
    inputs = [_column(log, n, name=_plain(n, log), change=_slew(log, n), moves=_moves(log, n)) for n in log.inputs]
    if not inputs:
        notes.append(f"no column is an input for certain: its name begins with `{COMMAND} `, or its values are held")
    return InferredSchema(float(f"{log.period:.3g}"), tuple(states), tuple(inputs), tuple(notes))


def _column(log: _Log, column: str, name: str = "", unit: str = "", **more: object) -> Column:
    values = log.all(column)
    unit = unit or log.units.get(column, "")
    return Column(name or column, unit, float(values.min()), float(values.max()), **more)  # type: ignore[arg-type]


def _plain(name: str, log: _Log) -> str:
    """What the description calls an input: `command NAME` is NAME where a coordinate has that name too."""
    short = name.removeprefix(f"{COMMAND} ")
    return short if short in log.runs[0].columns and short not in log.inputs else name


# --- from tables to rows ------------------------------------------------------------------------------------------


def _from_messages(tables: Sequence[Table]) -> _Log:
    def of(quantity: str) -> tuple[Table, str] | None:
        offers = [t for t in tables if quantity in t.columns]
        return (min(offers, key=lambda t: t.rank), quantity) if offers else None

    places = {axis: of(f"position.{axis}") for axis in AXES}
    flat = (up := places["z"]) is None or float(np.nanstd(up[0].columns[up[1]])) < 1e-3
    kinds = {q: (*named, of(q)) for q, named in (STATES if flat else SPACE).items()}
    told = INPUTS if flat else FLYING
    commands = {q: (*named, of(f"{COMMAND}.{q}")) for q, named in told.items()}
    found = {axis: place for axis, place in places.items() if place is not None and (axis != "z" or not flat)}
    if len(found) < 2:
        there = "; ".join(f"{t.name}: {', '.join(t.columns)}" for t in tables)
        raise NoSource(f"no message tells of positions (Odometry, PoseStamped, TF); there is: {there}")
    yaw = of("yaw") if flat else None
    units = {name: unit for name, unit, place in kinds.values() if place is not None}
    found |= {"heading": yaw} if yaw is not None else {}
    found |= {name: place for name, _, place in kinds.values() if place is not None}
    inputs = []
    for name, unit, place in commands.values():
        if place is not None:
            full = f"{COMMAND} {name}"
            found[full], units[full] = place, unit
            inputs.append(full)
    runs = _runs(found, inputs)
    heading = "heading" if yaw is not None else ""
    for run in runs if heading else ():
        run.columns[heading] = np.unwrap(run.columns[heading])
    return _Log(runs, [axis for axis in AXES if axis in found], inputs, _beat(runs, inputs), heading, units)


def _from_columns(table: Table) -> _Log:
    axes = {match[1].lower(): name for name in table.columns if (match := POSITION.fullmatch(name.strip()))}
    if not {"x", "y"} <= axes.keys():
        raise NoSource(f"no columns `x` and `y` of a position; there are: {', '.join(table.columns)}")
    places = [axes[axis] for axis in AXES if axis in axes]
    used = {name: (table, name) for name in table.columns if np.isfinite(table.columns[name]).any()}
    inputs = [name for name in used if INPUT.match(name)]
    if not inputs:
        repeated = {n: float(np.mean(np.diff(c[np.isfinite(c)]) == 0.0)) for n, c in table.columns.items() if n in used}
        inputs = [n for n, share in repeated.items() if share >= HELD and n not in places]
    runs = _runs(used, inputs)
    return _Log(runs, places, inputs, _beat(runs, inputs))


def _beat(runs: Sequence[_Rows], inputs: Sequence[str]) -> float:
    """s: the median time between two changes of an input; without any, between two rows."""
    changed = [np.any([np.diff(run.columns[name]) != 0.0 for name in inputs], axis=0) for run in runs if inputs]
    between = [np.diff(run.time[1:][at]) for run, at in zip(runs, changed, strict=False)]
    usual = _usual(runs[0].time)
    return max(float(np.median(np.concatenate(between))), usual) if sum(map(len, between)) else usual


def _usual(time: Array) -> float:
    return float(np.median(np.diff(time)))


def _runs(found: dict[str, tuple[Table, str]], inputs: Sequence[str]) -> list[_Rows]:
    """All columns on the clock of the first: states between two samples linearly, inputs held."""
    first = next(iter(found.values()))[0]
    made = []
    for run in np.unique(first.run) if len(first.run) else [0]:
        series = {name: table.series(column, int(run)) for name, (table, column) in found.items()}
        if any(len(time) < 2 for time, _ in series.values()):
            continue
        begin, end = max(t[0] for t, _ in series.values()), min(t[-1] for t, _ in series.values())
        clock = next(iter(series.values()))[0]
        clock = clock[(clock >= begin) & (clock <= end)]
        if len(clock) < FEW:
            continue
        columns = {}
        for name, (time, values) in series.items():
            if name in inputs:
                columns[name] = values[np.searchsorted(time, clock + 1e-9, "right") - 1]
            else:
                columns[name] = np.interp(clock, time, values)
        made.append(_Rows(clock, columns))
    if not made:
        raise NoSource(f"no {FEW} rows at which all columns have values")
    return made


# --- what the motion shows ----------------------------------------------------------------------------------------


def _read_motion(log: _Log, notes: list[str]) -> None:
    """Which column is the heading, and the units of those that show how fast it goes or turns."""
    flat = len(log.places) == 2
    open_to = [n for n in log.runs[0].columns if n not in (*log.places, *log.inputs)]
    if flat:
        scores = {n: _along(log, n) for n in open_to}
        named = [n for n in open_to if HEADING.fullmatch(n.strip())]
        best = max(scores, key=lambda n: scores[n], default="")
        if best and scores[best] > ALIKE:
            log.heading = best
        elif named:
            log.heading = named[0]
            notes.append(f"{named[0]} is the heading by its name: the motion does not follow it")
        else:
            notes.append("no column is the heading for certain: the motion follows none, and none has its name")
    for run in log.runs if log.heading else ():
        run.columns[log.heading] = np.unwrap(run.columns[log.heading])
    speeds = _speeds(log)
    for name in open_to:
        if name == log.heading:
            continue
        for unit, measured in speeds:
            if _same(measured, _means(log, name)):
                log.units[name] = unit
                break


def _along(log: _Log, name: str) -> float:
    """How well an angle shows the way it goes, forwards or backwards: the mean of |cos|, less what chance gives."""
    found = []
    for run, i, j in log.spans(SPAN):
        way = np.stack([run.columns[p][j] - run.columns[p][i] for p in log.places])
        length = np.hypot(*way)
        far = length > 0.3 * length.max(initial=0.0)
        angle = run.columns[name][(i + j) // 2]
        found.append((np.abs(np.cos(np.arctan2(way[1], way[0]) - angle)) * far)[far])
    values = np.concatenate(found)
    # An angle that never turns is as good as one that follows a straight way: nothing is told by it.
    turned = np.ptp(log.all(name)) > 0.5
    return float(values.mean()) if turned and len(values) >= FEW else 0.0


def _speeds(log: _Log) -> list[tuple[str, Array]]:
    """(unit, what is measured of it in each span): along and across the heading, or the axes; and the turning."""
    found: dict[str, list[Array]] = {}
    for run, i, j in log.spans(SPAN):
        time = run.time[j] - run.time[i]
        way = [(run.columns[p][j] - run.columns[p][i]) / time for p in log.places]
        if log.heading:
            middle = run.columns[log.heading][(i + j) // 2]
            turned = (run.columns[log.heading][j] - run.columns[log.heading][i]) / time
            cos, sin = np.cos(middle), np.sin(middle)
            way = [cos * way[0] + sin * way[1], cos * way[1] - sin * way[0], turned]
        for k, part in enumerate(way):
            found.setdefault("rad/s" if log.heading and k == 2 else f"m/s {k}", []).append(part)
    return [(unit.split(" ")[0], np.concatenate(parts)) for unit, parts in found.items()]


def _means(log: _Log, name: str) -> Array:
    """A column's mean in each span."""
    found = []
    for run, i, j in log.spans(SPAN):
        sums = np.concatenate([[0.0], np.cumsum(run.columns[name])])
        found.append((sums[j + 1] - sums[i]) / (j - i + 1))
    return np.concatenate(found)


def _same(one: Array, other: Array, least: float = ALIKE) -> bool:
    if len(one) < FEW or np.ptp(one) == 0.0 or np.ptp(other) == 0.0:
        return False
    slope = float(np.std(other) / np.std(one))
    return float(np.corrcoef(one, other)[0, 1]) > least and GAIN[0] < slope < GAIN[1]


def _followers(log: _Log, others: Sequence[str]) -> tuple[dict[str, str], dict[str, float]]:
    """For each input the coordinate that comes to it, and for this the delay [s], where one does."""
    fits: list[tuple[float, str, str]] = []
    for name in log.inputs:
        for other in others:
            if log.units.get(name) and log.units.get(other) and log.units[name] != log.units[other]:
                continue
            fits.append((_following(log, name, other), name, other))
    # `command NAME` is what NAME is to come to, however slowly it does.
    named = {name: name.removeprefix(f"{COMMAND} ") for name in log.inputs}
    pairs = {name: other for name, other in named.items() if other in others}
    for score, name, other in sorted(fits, reverse=True):
        if score > FOLLOWS and name not in pairs and other not in pairs.values():
            pairs[name] = other
    delays = {}
    for name, other in pairs.items():
        series = [
            ((r.time, r.columns[name]), (r.time, r.columns[other]), float(r.time[0]), float(r.time[-1]))
            for r in log.runs
        ]
        if (seen := estimate_delay(series, log.period)) is not None:
            delays[other] = seen
    return pairs, delays


def _following(log: _Log, name: str, other: str) -> float:
    """The best correlation of an input with a coordinate some time later, if the gain is about 1; else 0."""
    best = 0.0
    for late in np.arange(0.0, MOST_LAG, max(_usual(log.runs[0].time), log.period / 4.0)):
        n = round(late / _usual(log.runs[0].time))
        told = np.concatenate([r.columns[name][: len(r.time) - n] for r in log.runs if len(r.time) > n])
        seen = np.concatenate([r.columns[other][n:] for r in log.runs if len(r.time) > n])
        if _same(told, seen, best):
            best = float(np.corrcoef(told, seen)[0, 1])
    return best


def _slew(log: _Log, name: str) -> float:
    """The largest change over a period."""
    return max(float(np.abs(run.columns[name][j] - run.columns[name][i]).max()) for run, i, j in log.spans(log.period))


def _braking(log: _Log, name: str) -> float:
    """By how much its size falls in a period, in one of twenty of those in which it falls by more than noise."""
    falls = [np.abs(run.columns[name][i]) - np.abs(run.columns[name][j]) for run, i, j in log.spans(log.period)]
    seen = np.concatenate(falls)
    seen = seen[seen > 0.02 * np.abs(log.all(name)).max()]
    return float(np.quantile(seen, 0.95)) if len(seen) >= FEW else 0.0


def _moves(log: _Log, name: str) -> bool | None:
    """Does it go anywhere while all other inputs are none? None: that was never driven."""
    alone, driving = [], []
    seconds = max(2.0 * log.period, SPAN)
    for run, i, j in log.spans(seconds):
        way = np.linalg.norm([run.columns[p][j] - run.columns[p][i] for p in log.places], axis=0)
        small = [np.abs(run.columns[n]) <= 0.05 * np.abs(log.all(n)).max() for n in log.inputs if n != name]
        large = np.abs(run.columns[name]) > 0.2 * np.abs(log.all(name)).max()
        calm = np.concatenate([[0], np.cumsum(large & np.all(small, axis=0) if small else large)])
        before = np.maximum(i - (j - i), 0)  # and for as long before: what went on from then is over
        kept = calm[j + 1] - calm[before] == j + 1 - before
        alone.append(way[kept])
        driving.append(way)
    ways = np.concatenate(alone)
    if len(ways) < FEW:
        return None
    return bool(np.quantile(ways, 0.5) > 0.1 * np.quantile(np.concatenate(driving), 0.9))

"""Infer a robot description from a log: states, inputs, units, period, ranges and delays.

Messages define their quantities (`sources/quantity_names.py`). In a file of columns, positions and inputs are found by
name. The role and the unit of any other column follow from its correlation with the motion.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from brakeline.deploy.data.aligned_log import AlignedLog, align
from brakeline.deploy.data.input_delay import estimate_delay
from brakeline.deploy.data.sources.quantity_names import AXES, COMMAND
from brakeline.deploy.data.sources.source_table import Array, Table
from brakeline.errors import NoSource

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


def infer_schema(tables: Sequence[Table]) -> InferredSchema:
    """Infer the schema of a log.

    Raises:
        NoSource: the log has fewer than two position columns; the message gives the expected names.
    """
    log = _from_messages(tables) if tables[0].name else _from_columns(tables[0])
    constant = [name for name, values in log.columns.items() if np.ptp(values) == 0.0]
    notes = [f"{name} never changes, so that it is left out" for name in constant]
    for name in constant:
        del log.columns[name]
    log.positions, log.inputs = ([n for n in names if n not in constant] for names in (log.positions, log.inputs))
    if len(log.positions) < 2:
        raise NoSource(
            f"the log needs two position columns ({', '.join(AXES)}) that change: {'; '.join(notes) or 'none'}"
        )
    if not tables[0].name:
        notes += _find_heading(log)
        _find_speeds(log)
    others = [n for n in log.columns if n not in (*log.positions, log.heading, *log.inputs)]
    pairs = _followers(log, others)
    for name, follower in pairs.items():
        log.units.setdefault(name, log.units.get(follower, ""))
    leader = {follower: name for name, follower in pairs.items()}
    states = [_column(log, name, role="position", unit="m") for name in log.positions]
    states += [_column(log, log.heading, role="heading", unit="rad")] if log.heading in log.columns else []
    states += [
        _column(log, n, follows=_plain(leader[n], log), change=_braking(log, n), delay=_delay(log, leader[n], n))
        if n in leader
        else _column(log, n, change=_braking(log, n))
        for n in others
    ]
    inputs = [_column(log, n, name=_plain(n, log), change=_slew(log, n), moves=_moves(log, n)) for n in log.inputs]
    if not inputs:
        notes.append(f"no column is clearly an input: name inputs `{COMMAND} NAME`, or log them as held values")
    return InferredSchema(float(f"{log.period:.3g}"), tuple(states), tuple(inputs), tuple(notes))


def _column(log: AlignedLog, column: str, name: str = "", unit: str = "", **more: Any) -> InferredColumn:
    values = log.columns[column]
    unit = unit or log.units.get(column, "")
    return InferredColumn(name or column, unit, float(values.min()), float(values.max()), **more)


def _plain(name: str, log: AlignedLog) -> str:
    """Return an input's name in the description: `command NAME` is NAME if a coordinate has that name too."""
    short = name.removeprefix(f"{COMMAND} ")
    return short if short in log.columns and short not in log.inputs else name


# --- columns and their roles by name ------------------------------------------------------------------------------


def _from_messages(tables: Sequence[Table]) -> AlignedLog:
    def field_of(quantity: str) -> tuple[Table, str] | None:
        candidates = [t for t in tables if quantity in t.columns]
        return (min(candidates, key=lambda t: t.rank), quantity) if candidates else None

    up = field_of("position.z")
    flat = up is None or float(np.nanstd(up[0].columns[up[1]])) < 1e-3
    fields: dict[str, tuple[Table, str]] = {}
    units: dict[str, str] = {}
    wanted = [(axis, "m", f"position.{axis}") for axis in (AXES[:2] if flat else AXES)]
    wanted += [("heading", "rad", "yaw")] if flat else []
    wanted += [(name, unit, quantity) for quantity, (name, unit) in (STATES if flat else SPACE).items()]
    commands = INPUTS if flat else FLYING
    wanted += [(f"{COMMAND} {name}", unit, f"{COMMAND}.{quantity}") for quantity, (name, unit) in commands.items()]
    for name, unit, quantity in wanted:
        if (place := field_of(quantity)) is not None:
            fields[name], units[name] = place, unit
    positions = [axis for axis in AXES if axis in fields]
    if len(positions) < 2:
        available = "; ".join(f"{t.name}: {', '.join(t.columns)}" for t in tables)
        raise NoSource(f"no message holds positions (Odometry, PoseStamped, TF). The source has: {available}")
    inputs = [name for name in fields if name.startswith(f"{COMMAND} ")]
    return align(fields, positions, inputs, units, "heading" if "heading" in fields else "")


def _from_columns(table: Table) -> AlignedLog:
    axes = {match[1].lower(): name for name in table.columns if (match := POSITION.fullmatch(name.strip()))}
    if not {"x", "y"} <= axes.keys():
        raise NoSource(f"the position columns `x` and `y` are missing; the columns are: {', '.join(table.columns)}")
    positions = [axes[axis] for axis in AXES if axis in axes]
    known = {name: values[np.isfinite(values)] for name, values in table.columns.items()}
    used = {name: (table, name) for name, values in known.items() if len(values)}
    inputs = [name for name in used if INPUT.match(name)] or [
        name for name in used if name not in positions and np.mean(np.diff(known[name]) == 0.0) >= HELD
    ]
    return align(used, positions, inputs, {})


# --- roles and units from the motion -------------------------------------------------------------------------------


def _find_heading(log: AlignedLog) -> list[str]:
    """Set the heading of a robot in the plane, and return notes on it."""
    if len(log.positions) != 2:
        return []
    candidates = [n for n in log.columns if n not in (*log.positions, *log.inputs)]
    scores = {n: _heading_score(log, n) for n in candidates}
    best = max(scores, key=lambda n: scores[n], default="")
    if best and scores[best] > SAME_CORRELATION:
        log.set_heading(best)
        return []
    if named := [n for n in candidates if HEADING.fullmatch(n.strip())]:
        log.set_heading(named[0])
        return [f"{named[0]} is taken as the heading by its name: the motion does not confirm it"]
    return ["no column is clearly the heading: none agrees with the motion, and none is named heading or yaw"]


def _heading_score(log: AlignedLog, name: str) -> float:
    """Return how well a column agrees with the direction of motion: the mean of |cos(direction - angle)|, in [0, 1]."""
    i, j = log.spans(SPAN)
    x, y = (log.change(p, i, j) for p in log.positions)
    length = np.hypot(x, y)
    far = length > 0.3 * length.max(initial=0.0)
    cosines = np.abs(np.cos(np.arctan2(y, x) - log.columns[name][(i + j) // 2]))[far]
    # On a straight path a constant agrees as well as the heading does: require that the angle changes.
    turned = np.ptp(log.columns[name]) > 0.5
    return float(cosines.mean()) if turned and len(cosines) >= FEWEST_SPANS else 0.0


def _find_speeds(log: AlignedLog) -> None:
    """Set the units of the columns that measure speeds: along and across the heading and around it, or along axes."""
    i, j = log.spans(SPAN)
    time = log.time[j] - log.time[i]
    speeds = [("m/s", log.change(p, i, j) / time) for p in log.positions]
    if log.heading:
        (_, x), (_, y) = speeds
        middle = log.columns[log.heading][(i + j) // 2]
        cos, sin = np.cos(middle), np.sin(middle)
        turned = log.change(log.heading, i, j) / time
        speeds = [("m/s", cos * x + sin * y), ("m/s", cos * y - sin * x), ("rad/s", turned)]
    for name, values in log.columns.items():
        if name not in (*log.positions, *log.inputs, log.heading):
            sums = np.concatenate([[0.0], np.cumsum(values)])
            means = (sums[j + 1] - sums[i]) / (j - i + 1)
            unit = next((unit for unit, speed in speeds if _correlation(speed, means) > SAME_CORRELATION), "")
            log.units |= {name: unit} if unit else {}


def _correlation(one: Array, other: Array) -> float:
    """Return the correlation of two series; 0 for too few values, or if the gain is not near 1."""
    if len(one) < FEWEST_SPANS or np.ptp(one) == 0.0 or np.ptp(other) == 0.0:
        return 0.0
    near = SAME_GAIN[0] < float(np.std(other) / np.std(one)) < SAME_GAIN[1]
    return float(np.corrcoef(one, other)[0, 1]) if near else 0.0


def _followers(log: AlignedLog, others: Sequence[str]) -> dict[str, str]:
    """Return for each input the coordinate that follows it."""
    # NAME follows `command NAME` by definition, however slowly.
    named = {name: name.removeprefix(f"{COMMAND} ") for name in log.inputs}
    pairs = {name: other for name, other in named.items() if other in others}
    fits = [
        (_lagged_correlation(log, name, other), name, other)
        for name in log.inputs
        for other in others
        if log.units.get(name, "") in ("", log.units.get(other, "")) or not log.units.get(other)
    ]
    for score, name, other in sorted(fits, reverse=True):
        if score > FOLLOWS_CORRELATION and name not in pairs and other not in pairs.values():
            pairs[name] = other
    return pairs


def _lagged_correlation(log: AlignedLog, name: str, other: str) -> float:
    """Return the best correlation of an input with a coordinate up to `MAX_LAG` later; 0 if the gain is not near 1."""
    lags = np.arange(0.0, MAX_LAG, max(log.step, log.period / 4.0))
    pairs = (log.rows_apart(round(lag / log.step)) for lag in lags)
    return max(_correlation(log.columns[name][i], log.columns[other][j]) for i, j in pairs)


def _delay(log: AlignedLog, name: str, follower: str) -> float | None:
    """Return the delay in s from an input to the coordinate that follows it, or None if nothing moved."""
    series = [(log.time[r], log.columns[name][r], log.columns[follower][r]) for r in log.runs()]
    recordings = [((t, u), (t, values), float(t[0]), float(t[-1])) for t, u, values in series]
    return estimate_delay(recordings, log.period)


def _slew(log: AlignedLog, name: str) -> float:
    """Return the largest change of an input over one period."""
    return float(np.abs(log.change(name, *log.spans(log.period))).max())


def _braking(log: AlignedLog, name: str) -> float:
    """Return the 95 % quantile of the decrease of a coordinate's magnitude per period, without noise."""
    i, j = log.spans(log.period)
    size = np.abs(log.columns[name])
    decrease = size[i] - size[j]
    decrease = decrease[decrease > 0.02 * size.max()]
    return float(np.quantile(decrease, 0.95)) if len(decrease) >= FEWEST_SPANS else 0.0


def _moves(log: AlignedLog, name: str) -> bool | None:
    """Return whether the input moves the robot while all others are zero; None if that was never recorded."""
    i, j = log.spans(max(2.0 * log.period, SPAN))
    way = np.linalg.norm([log.change(p, i, j) for p in log.positions], axis=0)
    sizes = {n: np.abs(log.columns[n]) / np.abs(log.columns[n]).max() for n in log.inputs}
    alone = np.all([size > 0.2 if n == name else size <= 0.05 for n, size in sizes.items()], axis=0)
    count = np.concatenate([[0], np.cumsum(alone)])
    before = np.maximum(i - (j - i), 0)  # and for as long before, so that earlier motion has ended
    isolated = way[count[j + 1] - count[before] == j + 1 - before]
    if len(isolated) < FEWEST_SPANS:
        return None
    return bool(np.quantile(isolated, 0.5) > 0.1 * np.quantile(way, 0.9))

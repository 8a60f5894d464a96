"""Infer a robot description from a log: states, inputs, units, period, ranges and delays.

Messages define their quantities (`sources/quantity_names.py`). In a file of columns, positions and inputs are found by
name. The role and the unit of any other column follow from its correlation with the motion.
"""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from brakeline.deploy.data.aligned_log import AlignedLog, align, joined
from brakeline.deploy.data.glitches import without_glitches
from brakeline.deploy.data.input_response import (
    braking_per_period,
    delay_of,
    followers_of_inputs,
    moves_alone,
)
from brakeline.deploy.data.log_options import PLAIN, LogOptions
from brakeline.deploy.data.message_columns import FIELDS
from brakeline.deploy.data.message_columns import HEADING as HEADING_NAME
from brakeline.deploy.data.motion_check import (
    SAME_CORRELATION,
    heading_problem,
    heading_unit,
    likely_unit,
    needless_conversion,
    needlessly_converted,
    same_gain,
    speed_contradiction,
    speed_fit,
    speeds_of_motion,
    world_speed_advice,
)
from brakeline.deploy.data.sources.quantity_names import (
    AXES,
    COMMAND,
    Place,
    Places,
    choice_notes,
    fields_named,
    first_ranked,
    in_header_unit,
    with_values,
)
from brakeline.deploy.data.sources.source_table import Array, Table, notes_of
from brakeline.deploy.data.stamps import TIME
from brakeline.deploy.data.unit_table import in_si, si_of, unit_option
from brakeline.errors import NoSource

POSITION = re.compile(r"(?:pos(?:ition)?[ _.]?|p)?([xyz])(?:[ _.]?pos(?:ition)?)?(?:[ _.]?m)?", re.IGNORECASE)
HEADING = re.compile(r"(?:heading|yaw|theta|psi)(?:[ _.](?:rad|deg))?", re.IGNORECASE)
INPUT = re.compile(rf"(?:{COMMAND}|cmd|input|set(?:point)?|target)(?![a-z])", re.IGNORECASE)
# For each quantity of a message: its name in a description, and its unit.
STATES = {"body.x": ("speed", "m/s"), "body.y": ("speed aside", "m/s"), "yaw rate": ("turn rate", "rad/s")}
FLYING = {f"velocity.{axis}": (f"v{axis}", "m/s") for axis in AXES}
SPACE = FLYING | {f"acceleration.{axis}": (f"a{axis}", "m/s2") for axis in AXES}
INPUTS = STATES | {"steering": ("steering", "rad"), "acceleration": ("acceleration", "m/s2")}
JUMP = 0.8  # share of an input's range: an input that changes more in one period has no slew limit
HELD = 0.5  # share of rows that repeat the row before: only inputs, which are held, repeat this often
MOST_UNKNOWN = 3  # columns of a file that nothing is known of; more are left out
FLAT = 1e-3  # m: a standard deviation of z below it is noise of a robot in the plane
CHOSEN_PERIOD = 0.1  # s, where the log shows no beat
GUESS = "a guess: the inputs of the log show no beat; take the period of your controller"
ENDLESS = 1e6  # periods of a stop: a damaged value falls forever
LONGEST_PLAN = 40  # periods: if a stop takes more, a period is several beats
NAMED = 12  # columns that a note names


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

    @property
    def jumps(self) -> bool:
        """Return whether an input changes so much in one period that it has no slew limit."""
        return not 0.0 < self.change < JUMP * (self.most - self.least)

    @property
    def steers(self) -> bool:
        """Return whether an input is an angle of steering, which a robot holds while it brakes."""
        return self.unit == "rad"


@dataclass(frozen=True)
class InferredSchema:
    """The parts of a robot description that a log shows. `notes` says what it does not show, and why."""

    period: float  # s
    why: str  # how the period was found
    states: tuple[InferredColumn, ...]  # in the order of a description
    inputs: tuple[InferredColumn, ...]
    notes: tuple[str, ...]


def infer_schema(*sources: Sequence[Table], options: LogOptions = PLAIN) -> InferredSchema:
    """Infer the schema of one or more logs of a robot.

    Args:
        sources: the tables of each log.
        options: where columns are, and in which units.

    Raises:
        NoSource: a log has fewer than two position columns, or units that the motion contradicts; the message says what
            to do.
    """
    log, notes = _read(sources, options)
    constant = [name for name, values in log.columns.items() if np.ptp(values) == 0.0]
    notes += [f"left out, as they never change: {_listed(constant)}"] if constant else []
    for name in constant:
        del log.columns[name]
    log.positions, log.inputs = ([n for n in names if n not in constant] for names in (log.positions, log.inputs))
    if len(log.positions) < 2:
        raise NoSource(
            f"the log needs two position columns ({', '.join(AXES)}) that change: {'; '.join(notes) or 'none'}"
        )
    if not sources[0][0].name:
        notes += _find_heading(log, options)
        notes += _find_speeds(log, options)
    others = [n for n in log.columns if n not in (*log.positions, log.heading, *log.inputs)]
    pairs = followers_of_inputs(log, others)
    for name, follower in pairs.items():
        log.units.setdefault(name, log.units.get(follower, ""))
    known = {*pairs.values(), *options.fields, *FIELDS, HEADING_NAME}
    unknown = [name for name in others if not log.units.get(name) and name not in known]
    if len(unknown) > MOST_UNKNOWN:
        notes.append(f"left out, as the motion shows no role of them: {_listed(unknown)}. --map NAME=COLUMN takes one")
        others = [name for name in others if name not in unknown]
    if not log.inputs:
        still = [name.removeprefix(f"{COMMAND} ") for name in constant if name.startswith(f"{COMMAND} ")]
        hint = f"record a drive with changing {' and '.join(still)}" if still else "or log them as held values"
        notes.append(f"no column is clearly an input: name inputs `{COMMAND} NAME`, {hint}")
    beat, why = _period(log)
    for count in (1, 2, 3, 4, 5, 8, 10, 15, 20):
        log.period = count * beat
        states, inputs = _states(log, others, pairs), _inputs(log)
        if sum(brake_periods(log.period, states, inputs)) <= LONGEST_PLAN:
            break
    why += f"; {count} of them, so that a stop takes at most {LONGEST_PLAN}" if count > 1 else ""
    return InferredSchema(float(f"{log.period:.3g}"), why, tuple(states), tuple(inputs), tuple(dict.fromkeys(notes)))


def without_inputs(schema: InferredSchema) -> InferredSchema:
    """Return a schema whose inputs are left out, because no description follows from them."""
    names = ", ".join(one.name for one in schema.inputs)
    note = f"no inputs of a robot: {names}; name the inputs with --map 'command NAME=COLUMN'"
    states = tuple(replace(one, follows="") for one in schema.states)
    notes = (*schema.notes, note)
    return replace(schema, period=CHOSEN_PERIOD, why=GUESS, states=states, inputs=(), notes=notes)


def _read(sources: Sequence[Sequence[Table]], options: LogOptions) -> tuple[AlignedLog, list[str]]:
    """Return the columns of all logs on one time, and notes on what was chosen and left out."""
    logs, notes = list[AlignedLog](), list[str]()
    for tables in sources:
        fields = _from_messages(tables, options) if tables[0].name else _from_columns(tables[0], options)
        places, more = without_glitches(fields.places, fields.positions, fields.heading)
        notes += [*notes_of(tables), *fields.notes, *choice_notes(tables, places), *more]
        logs.append(align(places, fields.positions, fields.inputs, fields.units, fields.heading))
    log = joined(logs)
    if lost := sorted({name for one in logs for name in one.columns} - set(log.columns)):
        notes.append(f"left out, as not every log has them: {', '.join(lost)}")
    return log, notes + options.conversion_notes()


def _period(log: AlignedLog) -> tuple[float, str]:
    """Return the period in s, and how it was found."""
    beat = log.beat()
    if beat is not None:
        return beat.seconds, (
            f"the beat of the inputs: {beat.share:.0%} of {beat.changes} times between two changes are multiples of it"
        )
    if log.inputs and log.input_step >= log.step:
        return log.input_step, "the time between two messages of the inputs, which hardly change"
    period = log.step * max(math.ceil(CHOSEN_PERIOD / log.step - 1e-6), 1)
    return period, GUESS


def brake_periods(period: float, states: Sequence[InferredColumn], inputs: Sequence[InferredColumn]) -> tuple[int, int]:
    """Return the periods of the strongest braking, and those of the longest delay: estimates, not bounds."""
    held = {c.name for c in inputs if c.steers}
    braking = [c for c in states if c.follows and c.follows not in held]
    ramps = [(max(-c.least, c.most), c.change) for c in inputs if not (c.jumps or c.steers) and c.change > 0.0]
    falls = [(max(abs(c.least), abs(c.most)), c.change) for c in braking if c.change > 0.0]
    brake = max((math.ceil(round(min(ENDLESS, most / change), 6)) for most, change in (*ramps, *falls)), default=1)
    return brake, math.ceil(round(max((c.delay or 0.0 for c in states), default=0.0) / period, 3))


def _states(log: AlignedLog, others: Sequence[str], pairs: dict[str, str]) -> list[InferredColumn]:
    leader = {follower: name for name, follower in pairs.items()}
    states = [_column(log, name, role="position", unit="m") for name in log.positions]
    states += [_column(log, log.heading, role="heading", unit="rad")] if log.heading in log.columns else []
    return states + [
        _column(
            log, n, follows=_plain(leader[n], log), change=braking_per_period(log, n), delay=delay_of(log, leader[n], n)
        )
        if n in leader
        else _column(log, n, change=braking_per_period(log, n))
        for n in others
    ]


def _inputs(log: AlignedLog) -> list[InferredColumn]:
    spans = log.input_spans()
    most = {n: float(np.abs(log.change(n, *spans)).max()) for n in log.inputs}  # changes over one period
    return [_column(log, n, name=_plain(n, log), change=most[n], moves=moves_alone(log, n)) for n in log.inputs]


def _column(log: AlignedLog, column: str, name: str = "", unit: str = "", **more: Any) -> InferredColumn:
    values = log.columns[column]
    unit = unit or log.units.get(column, "")
    return InferredColumn(name or column, unit, float(values.min()), float(values.max()), **more)


def _plain(name: str, log: AlignedLog) -> str:
    """Return an input's name in the description: `command NAME` is NAME if a coordinate has that name too."""
    short = name.removeprefix(f"{COMMAND} ")
    return short if short in log.columns and short not in log.inputs else name


# --- columns and their roles by name ------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Fields:
    """The columns of a log with their roles."""

    places: Places
    positions: list[str]
    inputs: list[str]
    units: dict[str, str]
    heading: str = ""
    notes: tuple[str, ...] = ()


def _from_messages(tables: Sequence[Table], options: LogOptions) -> _Fields:
    def field_of(quantity: str, name: str) -> Place | None:
        if name in options.fields:
            candidates = fields_named(tables, options.fields[name])
            if not candidates:
                raise NoSource(f"--map {name}={options.fields[name]}: there is no such field; {_content(tables)}")
        else:
            candidates = first_ranked([(t, quantity) for t in tables if quantity in t.columns])
        if len(candidates) > 1:
            many = ", ".join(f"{t.name}/{f}" for t, f in candidates)
            raise NoSource(
                f"{name}: several fields match; choose a topic with --topics {candidates[0][0].name}: {many}"
            )
        return candidates[0] if candidates else None

    up = field_of("position.z", "z")
    flat = up is None or _is_flat(up[0].columns[up[1]])
    wanted = [(axis, "m", f"position.{axis}") for axis in (AXES[:2] if flat else AXES)]
    wanted += [("heading", "rad", "yaw")] if flat else []
    wanted += [(name, unit, quantity) for quantity, (name, unit) in (STATES if flat else SPACE).items()]
    commands = INPUTS if flat else FLYING
    wanted += [(f"{COMMAND} {name}", unit, f"{COMMAND}.{quantity}") for quantity, (name, unit) in commands.items()]
    wanted += [(name, "", "") for name in options.fields if name not in (TIME, *(name for name, _, _ in wanted))]
    fields = {name: (place, unit) for name, unit, quantity in wanted if (place := field_of(quantity, name)) is not None}
    positions = [axis for axis in AXES if axis in fields]
    if len(positions) < 2:
        raise NoSource(f"no message holds positions (Odometry, PoseStamped, TF). {_content(tables)}")
    inputs = [name for name in fields if name.startswith(f"{COMMAND} ")]
    places, units = _in_si({name: place for name, (place, _) in fields.items()}, options)
    units = {name: unit for name, (_, unit) in fields.items()} | units
    return _Fields(places, positions, inputs, units, "heading" if "heading" in fields else "")


def _content(tables: Sequence[Table]) -> str:
    return f"The source has: {'; '.join(f'{t.name}: {_listed(list(t.columns))}' for t in tables)}"


def _from_columns(table: Table, options: LogOptions) -> _Fields:
    chosen = {n: next((f for _, f in fields_named([table], p)), p) for n, p in options.fields.items() if n != TIME}
    if missing := [place for place in chosen.values() if place not in table.columns]:
        raise NoSource(f"--map: there is no column {missing[0]}; the columns are: {', '.join(table.columns)}")
    axes = {m[1].lower(): name for name in (*table.columns,)[::-1] if (m := POSITION.fullmatch(name.strip()))}
    axes |= {axis: axis for axis in AXES if axis in chosen or axis in table.columns}
    if not {"x", "y"} <= axes.keys():
        raise NoSource(
            f"the position columns `x` and `y` are missing; the columns are: {', '.join(table.columns)}. Name every "
            "column of the robot with --map, because the command then reads no others: --map x=COLUMN y=COLUMN "
            f"heading=COLUMN SPEED=COLUMN '{COMMAND} INPUT=COLUMN' …"
        )
    flat = axes.pop("z") if "z" in axes and "z" not in chosen and _is_flat(table.columns[axes["z"]]) else ""
    notes: tuple[str, ...] = (f"left out, as it changes by less than a millimetre: {flat}",) if flat else ()
    positions = [axes[axis] for axis in AXES if axis in axes]
    # Those who name columns name all that matter.
    names = (
        [*positions, *(n for n in chosen if n not in positions)] if chosen else [n for n in table.columns if n != flat]
    )
    if unnamed := [c for c in table.columns if chosen and c not in (*names, *chosen.values())]:
        notes += (f"left out, as --map does not name them: {_listed(unnamed)}",)
    places: Places = {name: (table, chosen.get(name, name)) for name in names}
    places = {name: place for name, place in places.items() if np.isfinite(table.columns[place[1]]).any()}
    known = {name: values[np.isfinite(values)] for name, (t, c) in places.items() for values in (t.columns[c],)}
    inputs = [name for name in places if INPUT.match(name)] or [
        name for name in places if name not in positions and np.mean(np.diff(known[name]) == 0.0) >= HELD
    ]
    headed = {name: in_header_unit(place) for name, place in places.items() if name not in options.units}
    places, units = _in_si(places | {name: place for name, (place, _) in headed.items()}, options)
    units = {name: si for name, (_, si) in headed.items() if si} | units
    return _Fields(places, positions, inputs, units, notes=notes)


def _is_flat(z: Array) -> bool:
    """Return whether a robot stays in the plane, by its z."""
    known = z[np.isfinite(z)]
    return len(known) > 0 and float(known.std()) < FLAT


def _in_si(places: Places, options: LogOptions) -> tuple[Places, dict[str, str]]:
    """Return the places in SI units, as `--unit` says, and the SI unit of each that it names."""
    options.check_names(list(places))
    units = {name: si_of(unit) for name, unit in options.units.items() if name != TIME}
    for name, si in units.items():
        table, column = places[name]
        values = in_si(table.columns[column], options.units[name], si) if si else None
        if values is not None:
            places = places | {name: with_values(places[name], values)}
    return places, units


def _listed(names: Sequence[str]) -> str:
    more = f" and {len(names) - NAMED} more" if len(names) > NAMED else ""
    return ", ".join(names[:NAMED]) + more


# --- roles and units from the motion -------------------------------------------------------------------------------


def _find_heading(log: AlignedLog, options: LogOptions) -> list[str]:
    """Set the heading of a robot in the plane, and return notes on it.

    Raises:
        NoSource: it is in another unit, or in rad and converted all the same.
    """
    if len(log.positions) != 2:
        return []
    candidates = [n for n in log.columns if n not in (*log.positions, *log.inputs)]
    fits = {name: heading_unit(log, name, options.units.get(name, "")) for name in candidates}
    best = max(fits, key=lambda name: fits[name][1], default="")
    confirmed = best != "" and fits[best][1] > SAME_CORRELATION
    named = [best] if confirmed else [n for n in candidates if HEADING.fullmatch(n.strip())]
    if named:
        if problem := heading_problem(log, named[0], options.units):
            raise NoSource(problem)
        log.set_heading(named[0])
        note = f"{named[0]} is taken as the heading by its name: the motion does not confirm it"
        return [] if confirmed else [note]
    return ["no column is clearly the heading: none agrees with the motion, and none is named heading or yaw"]


def _find_speeds(log: AlignedLog, options: LogOptions) -> list[str]:
    """Set the units of the columns that measure speeds, and return notes on inputs that may be in another unit.

    Raises:
        NoSource: a speed is in another unit.
    """
    speeds = speeds_of_motion(log, log.heading)
    problems, notes = list[str](), list[str]()
    for name in log.columns:
        if name in (*log.positions, log.heading):
            continue
        fit, given = speed_fit(log, name, speeds, name in log.inputs), options.units.get(name)
        if fit is None:
            notes += [text] if (text := world_speed_advice(log, name, log.heading)) else []
            continue
        if given is not None:
            if needlessly_converted(fit, given):
                problems.append(needless_conversion(name, given, fit.unit))
            continue
        if same_gain(fit.gain):
            log.units |= {} if name in log.inputs else {name: fit.unit}
        elif problem := speed_contradiction(name, fit):
            problems.append(problem)
        elif name in log.inputs and not log.units.get(name) and (unit := likely_unit(fit.gain, fit.unit)):
            notes.append(
                f"{name} may be in {unit}: it is {fit.gain:.3g} times the speed or turn rate that follows it, in "
                f"{fit.unit}. If so, delete the file and repeat the command with {unit_option(name, unit)}"
            )
    if problems:
        raise NoSource("\n".join((*problems, "If a column is no speed, give it --unit NAME=1")))
    return notes

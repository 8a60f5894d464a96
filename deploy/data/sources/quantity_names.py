"""Map the columns of a source to the coordinates and inputs of a robot.

In a file of columns, the name of a coordinate is the name of its column. In messages, the quantity decides. The option
`--map NAME=TABLE/FIELD` overrides both, and `--topics` prefers tables. Readers of messages return these quantities, in
SI units and ENU:

    position.x position.y position.z   m        yaw             rad, from x to y
    velocity.x ... (in the world)      m/s      yaw rate        rad/s
    body.x body.y body.z (forward, left, up)    acceleration.x ...  m/s², in the world
    command.velocity.x ... command.body.x ... command.yaw rate   command.steering   command.acceleration
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from brakeline.deploy.data.log_options import LogOptions
from brakeline.deploy.data.sources.source_table import Array, Table, folded, notes_of
from brakeline.deploy.data.unit_table import AS_IT_IS, factor, in_si, si_of, split_header, unknown_unit
from brakeline.errors import NoSource
from brakeline.messaging.labels import split_label
from brakeline.messaging.robot import Robot

AXES = "xyz"
COMMAND = "command"
Place = tuple[Table, str]  # a table and the name of its field
Places = dict[str, Place]


def column_names(robot: Robot) -> tuple[list[str], list[str]]:
    """Return the column names of states and inputs. An input with the name of a coordinate becomes `command NAME`."""
    states = [split_label(label)[0] for label in robot.state]
    inputs = [split_label(label)[0] for label in robot.action]
    return states, [f"{COMMAND} {name}" if name in states else name for name in inputs]


def column_units(robot: Robot) -> dict[str, str]:
    """Return the unit of each column, states before inputs."""
    states, inputs = column_names(robot)
    labels = zip((*states, *inputs), (*robot.state, *robot.action), strict=True)
    return {name: split_label(label)[1] for name, label in labels}


def quantities(robot: Robot) -> dict[str, str]:
    """Return the quantity of each column whose role and unit determine it. In joint space there is none."""
    if not robot.position_dim:
        return {}
    states, inputs = column_names(robot)
    frame = "velocity" if robot.heading is None else "body"
    quantity_of: dict[str, str] = {}

    def next_axis(kind: str) -> str:
        return f"{kind}.{AXES[min(sum(q.startswith(f'{kind}.') for q in quantity_of.values()), 2)]}"

    for i, name in enumerate(states):
        unit = split_label(robot.state[i])[1]
        if i < robot.position_dim:
            quantity_of[name] = f"position.{AXES[i]}"
        elif i == robot.heading:
            quantity_of[name] = "yaw"
        elif unit in ("m/s", "m/s2"):
            quantity_of[name] = next_axis(frame if unit == "m/s" else "acceleration")
        elif unit == "rad/s":
            quantity_of[name] = "yaw rate"
    for i, name in enumerate(inputs):
        unit = split_label(robot.action[i])[1]
        if unit == "m/s":
            quantity_of[name] = next_axis(f"{COMMAND}.{frame}")
        elif (kind := {"rad/s": "yaw rate", "rad": "steering", "m/s2": "acceleration"}.get(unit)) is not None:
            quantity_of[name] = f"{COMMAND}.{kind}"
    return quantity_of


def resolve(tables: Sequence[Table], robot: Robot, options: LogOptions) -> Places:
    """Find the table and the field of each column of the robot, in the robot's unit.

    Raises:
        NoSource: columns are missing or ambiguous; the message lists them all, and the content of the source.
    """
    usual, wanted_units = quantities(robot), column_units(robot)
    options.check_names(list(wanted_units))
    places: Places = {}
    problems: list[str] = []
    name_of: dict[tuple[str, str], str] = {}  # of each field that is used
    for name, unit in wanted_units.items():
        if name in options.fields:
            candidates = fields_named(tables, options.fields[name])
            wanted = f"{options.fields[name]!r} (--map)"
        else:
            # `x` of a message may point north: match by name only in files of columns.
            plain = [table for table in tables if not table.name]
            candidates = [(t, name) for t in plain if name in t.columns]
            candidates = candidates or [(t, f) for t in plain for f in t.columns if folded(f) == folded(name)]
            candidates = candidates or [(t, usual[name]) for t in tables if usual.get(name) in t.columns]
            wanted = f"a column {name!r}" + (f" or a message with {usual[name]}" if name in usual else "")
        candidates = first_ranked(candidates)
        if name not in (*options.fields, *options.units) and (foreign := _in_unknown_units(candidates)):
            problems.append(
                f"{name}: {', '.join(foreign)} is in no known unit; name it with --unit {name!r}=UNIT. Or convert the "
                f"column to {unit or '1'}, and take it with --map {name!r}=COLUMN"
            )
        elif len(candidates) == 1 and (other := name_of.setdefault(_label(candidates[0]), name)) != name:
            problems.append(
                f"{name}: {other} is from {candidates[0][1]} too; name another field for one of them with "
                f"--map {name!r}=TABLE/FIELD"
            )
        elif len(candidates) == 1:
            given = options.units.get(name, "")
            places[name] = _in_unit(candidates[0], name, given, unit) if given else in_header_unit(candidates[0])[0]
        elif candidates:
            many = ", ".join(f"{t.name}/{f}" for t, f in candidates)
            problems.append(
                f"{name}: several fields match; choose one with --map {name!r}=TABLE/FIELD, or a topic with --topics: "
                f"{many}"
            )
        else:
            problems.append(f"{name}: there is no {wanted.removeprefix('a ')}")
    if problems:
        available = "; ".join(f"{t.name or 'columns'}: {', '.join(t.columns)}" for t in tables) or "nothing"
        raise NoSource(
            f"the source does not contain every column of the description of {robot.name}:\n  "
            + "\n  ".join(problems)
            + f"\nThe source contains: {available}. Name a field with --map NAME=TABLE/FIELD."
            + "".join(f"\n{note}" for note in notes_of(tables))
        )
    return places


def fields_named(tables: Sequence[Table], place: str) -> list[Place]:
    """Return the fields that `TABLE/FIELD` or `FIELD` names, or the header `FIELD [UNIT]` of a file of columns."""
    named = [(t, f) for t in tables for f in t.columns if place in (f"{t.name}/{f}", f)]
    return named or [(t, f) for t in tables for f in t.units if f in t.columns and f == split_header(place)[0]]


def first_ranked(candidates: Sequence[Place]) -> list[Place]:
    """Return the candidates of the lowest rank."""
    lowest = min((table.rank for table, _ in candidates), default=0)
    return [(table, field) for table, field in candidates if table.rank == lowest]


def choice_notes(tables: Sequence[Table], places: Places) -> list[str]:
    """Say for each quantity that several tables hold which one is used, and how to choose another."""
    used: dict[tuple[str, tuple[str, ...]], list[str]] = {}
    for name, (table, column) in places.items():
        others = tuple(t.name for t in tables if column in t.columns and t.name != table.name)
        if others:
            used.setdefault((table.name, others), []).append(name)
    return [
        f"{', '.join(names)}: from {name}; {', '.join(others)} also {'holds' if len(others) == 1 else 'hold'} "
        f"{'it' if len(names) == 1 else 'them'} (choose with --topics {others[0]})"
        for (name, others), names in used.items()
    ]


def with_values(place: Place, values: Array) -> Place:
    """Return a place whose field has other values."""
    table, column = place
    return replace(table, columns=table.columns | {column: values}), column


def in_header_unit(place: Place) -> tuple[Place, str]:
    """Return a place in the unit of its header, converted to SI, and the SI unit; empty if the header names none.

    `stamps.in_header_units` converts columns too, but not `NAME [UNIT]` beside a column NAME.
    """
    table, column = place
    unit = "" if table.name else split_header(column)[1]
    if not unit or si_of(unit) == "s":
        return place, table.units.get(column, "")
    return with_values(place, table.columns[column] * (factor(unit) or 1.0)), si_of(unit)


def _label(place: Place) -> tuple[str, str]:
    return place[0].name, place[1]


def _in_unknown_units(candidates: Sequence[Place]) -> list[str]:
    """Return the fields whose header has a unit that is not known; `-` means none."""
    return [field for _, field in candidates if unknown_unit(field) not in ("", "-")]


def _in_unit(place: Place, name: str, given: str, unit: str) -> Place:
    """Return a place with its values in the robot's unit."""
    table, column = place
    if given in ("", AS_IT_IS):
        return place
    values = in_si(table.columns[column], given, unit)
    if values is None:
        raise NoSource(f"--unit {name}={given}: {name} is in {unit or '1'}, to which {given} cannot be converted")
    return with_values(place, values)

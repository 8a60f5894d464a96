"""Which column of which table is which coordinate of a robot.

A column of a file is found by the coordinate's own name, one of a message by the quantity it is, either by `--map
NAME=TABLE/FIELD`. Readers of messages give the names below, in SI units and ENU, whatever their source has.

    position.x position.y position.z   m        yaw             rad, from x to y
    velocity.x ... (in the world)      m/s      yaw rate        rad/s
    body.x body.y body.z (forward, left, up)    acceleration.x ...  m/s², in the world
    command.velocity.x ... command.body.x ... command.yaw rate   command.steering   command.acceleration
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence

from brakeline.deploy.data.sources.source_table import NoSource, Table
from brakeline.messaging.robot import Robot

AXES = "xyz"
COMMAND = "command"


def split(label: str) -> tuple[str, str]:
    """Name and unit of `name [unit]`."""
    name, _, unit = label.rpartition(" [")
    return name, unit.removesuffix("]")


def column_names(robot: Robot) -> tuple[list[str], list[str]]:
    """The names that the state's and the inputs' columns have; an input that shares its name with a coordinate of the
    state is `command NAME`."""
    states = [split(label)[0] for label in robot.state]
    inputs = [split(label)[0] for label in robot.action]
    return states, [f"{COMMAND} {name}" if name in states else name for name in inputs]


def quantities(robot: Robot) -> dict[str, str]:
    """For each of its columns the quantity it is by role and unit, where that is plain."""
    states, inputs = column_names(robot)
    frame = "velocity" if robot.heading is None else "body"
    found: dict[str, str] = {}

    def next_axis(kind: str) -> str:
        return f"{kind}.{AXES[min(sum(q.startswith(f'{kind}.') for q in found.values()), 2)]}"

    for i, name in enumerate(states):
        unit = split(robot.state[i])[1]
        if i < robot.position_dim:
            found[name] = f"position.{AXES[i]}"
        elif i == robot.heading:
            found[name] = "yaw"
        elif unit in ("m/s", "m/s2"):
            found[name] = next_axis(frame if unit == "m/s" else "acceleration")
        elif unit == "rad/s":
            found[name] = "yaw rate"
    for i, name in enumerate(inputs):
        unit = split(robot.action[i])[1]
        if unit == "m/s":
            found[name] = next_axis(f"{COMMAND}.{frame}")
        elif (kind := {"rad/s": "yaw rate", "rad": "steering", "m/s2": "acceleration"}.get(unit)) is not None:
            found[name] = f"{COMMAND}.{kind}"
    return found


def mapping(words: Iterable[str], robot: Robot) -> dict[str, str]:
    """`--map` options as {column: TABLE/FIELD}.

    Raises:
        NoSource: one is none, or its name is none of the robot's.
    """
    states, inputs = column_names(robot)
    found: dict[str, str] = {}
    for word in words:
        name, equals, place = word.partition("=")
        if not equals or name not in (*states, *inputs):
            raise NoSource(f"--map {word!r}: NAME=TABLE/FIELD, where NAME is one of {', '.join((*states, *inputs))}")
        found[name] = place
    return found


def resolve(tables: Sequence[Table], robot: Robot, chosen: dict[str, str]) -> dict[str, tuple[Table, str]]:
    """For each column of the robot the table and the field in it.

    Raises:
        NoSource: with everything that is missing, or that several tables offer, and what there is.
    """
    usual = quantities(robot)
    found: dict[str, tuple[Table, str]] = {}
    problems: list[str] = []
    for name in (*column_names(robot)[0], *column_names(robot)[1]):
        if name in chosen:
            offers = [(t, f) for t in tables for f in t.columns if chosen[name] in (f"{t.name}/{f}", f)]
            wanted = f"{chosen[name]!r} (--map)"
        else:
            # A message's `x` may be another's north: names count in files of columns alone.
            offers = [(t, name) for t in tables if not t.name and name in t.columns]
            offers = offers or [(t, usual[name]) for t in tables if usual.get(name) in t.columns]
            wanted = f"a column {name!r}" + (f" or a message with {usual[name]}" if name in usual else "")
        offers = [offer for offer in offers if offer[0].rank == min(table.rank for table, _ in offers)]
        if len(offers) == 1:
            found[name] = offers[0]
        elif offers:
            many = ", ".join(f"{t.name}/{f}" for t, f in offers)
            problems.append(f"{name}: several have it; choose with --map {name!r}=TABLE/FIELD: {many}")
        else:
            problems.append(f"{name}: there is no {wanted.removeprefix('a ')}")
    if problems:
        there = "; ".join(f"{t.name or 'columns'}: {', '.join(t.columns)}" for t in tables) or "nothing"
        raise NoSource(
            "what the robot's description names is not all in the source:\n  "
            + "\n  ".join(problems)
            + f"\nthere is: {there}"
        )
    return found

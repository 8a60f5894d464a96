"""Map the columns of a source to the coordinates and inputs of a robot.

In a file of columns, the name of a coordinate is the name of its column. In messages, the quantity decides. The option
`--map NAME=TABLE/FIELD` overrides both. Readers of messages return these quantities, in SI units and ENU:

    position.x position.y position.z   m        yaw             rad, from x to y
    velocity.x ... (in the world)      m/s      yaw rate        rad/s
    body.x body.y body.z (forward, left, up)    acceleration.x ...  m/s², in the world
    command.velocity.x ... command.body.x ... command.yaw rate   command.steering   command.acceleration
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence

from brakeline.deploy.data.sources.source_table import Table
from brakeline.errors import NoSource
from brakeline.messaging.robot import Robot

AXES = "xyz"
COMMAND = "command"


def split(label: str) -> tuple[str, str]:
    """Split a label `name [unit]` into name and unit."""
    name, _, unit = label.rpartition(" [")
    return name, unit.removesuffix("]")


def column_names(robot: Robot) -> tuple[list[str], list[str]]:
    """Return the column names of states and inputs. An input with the name of a coordinate becomes `command NAME`."""
    states = [split(label)[0] for label in robot.state]
    inputs = [split(label)[0] for label in robot.action]
    return states, [f"{COMMAND} {name}" if name in states else name for name in inputs]


def quantities(robot: Robot) -> dict[str, str]:
    """Return the quantity of each column whose role and unit determine it. In joint space there is none."""
    if not robot.position_dim:
        return {}
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
    """Parse `--map` options to {column: TABLE/FIELD}.

    Raises:
        NoSource: an option is malformed, or its name is not a column of the robot.
    """
    states, inputs = column_names(robot)
    found: dict[str, str] = {}
    for word in words:
        name, equals, place = word.partition("=")
        if not equals or name not in (*states, *inputs):
            raise NoSource(
                f"--map {word!r} must be NAME=TABLE/FIELD, where NAME is one of {', '.join((*states, *inputs))}"
            )
        found[name] = place
    return found


def resolve(tables: Sequence[Table], robot: Robot, chosen: dict[str, str]) -> dict[str, tuple[Table, str]]:
    """Find the table and the field of each column of the robot.

    Raises:
        NoSource: columns are missing or ambiguous; the message lists them all, and the content of the source.
    """
    usual = quantities(robot)
    found: dict[str, tuple[Table, str]] = {}
    problems: list[str] = []
    for name in (*column_names(robot)[0], *column_names(robot)[1]):
        if name in chosen:
            candidates = [(t, f) for t in tables for f in t.columns if chosen[name] in (f"{t.name}/{f}", f)]
            wanted = f"{chosen[name]!r} (--map)"
        else:
            # `x` of a message may point north: match by name only in files of columns.
            candidates = [(t, name) for t in tables if not t.name and name in t.columns]
            candidates = candidates or [(t, usual[name]) for t in tables if usual.get(name) in t.columns]
            wanted = f"a column {name!r}" + (f" or a message with {usual[name]}" if name in usual else "")
        candidates = [
            candidate for candidate in candidates if candidate[0].rank == min(table.rank for table, _ in candidates)
        ]
        if len(candidates) == 1:
            found[name] = candidates[0]
        elif candidates:
            many = ", ".join(f"{t.name}/{f}" for t, f in candidates)
            problems.append(f"{name}: several fields match; choose one with --map {name!r}=TABLE/FIELD: {many}")
        else:
            problems.append(f"{name}: there is no {wanted.removeprefix('a ')}")
    if problems:
        available = "; ".join(f"{t.name or 'columns'}: {', '.join(t.columns)}" for t in tables) or "nothing"
        raise NoSource(
            "the source does not contain every column of the robot's description:\n  "
            + "\n  ".join(problems)
            + f"\nThe source contains: {available}. Name a field with --map NAME=TABLE/FIELD."
        )
    return found

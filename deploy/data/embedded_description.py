"""Write the robot description that a Brakeline log contains as the text of a description file."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

from brakeline.deploy.data.description_template import toml_key, toml_value
from brakeline.errors import NoSource
from brakeline.logs.reader import open_log
from brakeline.messaging.structured_text import parse_json

ROBOTS = "robots"  # metadata of a log: robot name -> description as JSON


def read_embedded_description(path: Path, name: str) -> str:
    """Return the description of the log's robot under the name `name`.

    If the log holds several robots, choose the one with this name.

    Raises:
        NoSource: the log contains no description, or several and none with this name.
        LogError: the file does not exist, or is not a log.
    """
    log = open_log(path)
    for _ in log:
        if ROBOTS in log.metadata:
            break
    descriptions = log.metadata.get(ROBOTS, {})
    if not descriptions:
        damage = "".join(f"; {cut}" for cut in log.cuts)
        raise NoSource(
            f"{path} contains no robot description{damage}. It is not the log of a run, or it is an old one: "
            "write one with `brakeline robot new` without --from"
        )
    if len(descriptions) > 1 and name not in descriptions:
        raise NoSource(f"{path} holds the robots {', '.join(descriptions)}: name the file after the one that you want")
    chosen = name if name in descriptions else next(iter(descriptions))
    described = parse_json(descriptions[chosen]) | {"name": name}
    return f"# The description of {chosen} from {path.name}.\n" + "\n".join(_lines(described)) + "\n"


def _lines(described: dict[str, Any]) -> Iterator[str]:
    """Yield the TOML lines: plain values first, then tables, then arrays of tables."""
    yield from _values({name: value for name, value in described.items() if not isinstance(value, dict | list)})
    for name, value in described.items():
        if isinstance(value, dict):
            yield f"\n[{toml_key(name)}]"
            yield from _values(value)
        for table in value if isinstance(value, list) else ():
            yield f"\n[[{toml_key(name)}]]"
            yield from _values(table)


def _values(table: dict[str, Any]) -> Iterator[str]:
    return (f"{toml_key(name)} = {toml_value(value)}" for name, value in table.items())

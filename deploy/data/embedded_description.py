"""The description of a robot that a log of a run carries, as the text of a file."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from brakeline.deploy.data.description_template import key
from brakeline.deploy.data.sources.source_table import NoSource
from brakeline.logs.reader import open_log

ROBOTS = "robots"  # a log's metadata: for each name the description as JSON


def read_embedded_description(path: Path, name: str) -> str:
    """The description of the log's robot, under a new name; of several robots, of the one that has this name.

    Raises:
        NoSource: it carries none, or several others; NoLog, NotALog: there is no log.
    """
    log = open_log(path)
    for _ in log:
        if ROBOTS in log.metadata:
            break
    found = log.metadata.get(ROBOTS, {})
    if not found:
        raise NoSource(f"{path} carries no robot's description: it is older than descriptions are")
    if len(found) > 1 and name not in found:
        raise NoSource(f"{path} is of {', '.join(found)}: name the file after the one that you want")
    chosen = name if name in found else next(iter(found))
    described = json.loads(found[chosen]) | {"name": name}
    return f"# The description of {chosen} that {path.name} carries.\n" + "\n".join(_lines(described)) + "\n"


def _lines(described: dict[str, Any]) -> Iterator[str]:
    """A file's lines: what is one value first, then tables, then lists of tables."""
    for name, value in described.items():
        if not isinstance(value, dict | list):
            yield f"{key(name)} = {_value(value)}"
    for name, value in described.items():
        if isinstance(value, dict):
            yield f"\n[{key(name)}]"
            yield from (f"{key(inner)} = {_value(one)}" for inner, one in value.items())
        elif isinstance(value, list):
            for table in value:
                yield f"\n[[{key(name)}]]"
                yield from (f"{key(inner)} = {_value(one)}" for inner, one in table.items())


def _value(value: Any) -> str:
    if isinstance(value, dict):
        return "{ " + ", ".join(f"{key(name)} = {_value(one)}" for name, one in value.items()) + " }"
    if isinstance(value, list):
        return "[" + ", ".join(map(_value, value)) + "]"
    return json.dumps(value)

"""Print the results of commands: as text for people, or with `--json` as one JSON object."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rich.console import Console, RenderableType

from brakeline.logs.json_values import finite
from brakeline.logs.stacking_table import StackingTable, plain_table

if TYPE_CHECKING:
    from brakeline.logs.reader import Damage

# The terminal breaks long lines (soft wrap); lines into a pipe stay whole.
console = Console(highlight=False, soft_wrap=True)
errors = Console(stderr=True, highlight=False, soft_wrap=True)


def print_json(figures: dict[str, Any]) -> None:
    """Print one JSON object on stdout. Numbers that are not finite become null, paths become text."""

    def path_text(value: object) -> str:
        if isinstance(value, Path):
            return str(value)
        raise TypeError(f"JSON holds no {type(value).__name__}")

    print(json.dumps(finite(figures), default=path_text))


def print_damage(damage: Damage) -> None:
    """Print on stderr what could not be read of a log."""
    for line in damage.lines:
        errors.print(line, markup=False)


def print_result(as_json: bool, figures: dict[str, Any], *lines: RenderableType) -> None:
    """Print the figures as one JSON object, or else the lines, whose text is no markup."""
    if as_json:
        print_json(figures)
        return
    for line in lines:
        console.print(line, markup=not isinstance(line, str))


def print_counts(figures: dict[str, float], as_json: bool) -> None:
    """Print named numbers: as JSON on stdout, or in one line on stderr."""
    if as_json:
        print_json(figures)
    else:
        errors.print(", ".join(f"{name} {value:g}" for name, value in figures.items()))


def conditions_table(conditions: dict[str, str]) -> StackingTable:
    """Return a table with one line for each recording condition."""
    return plain_table((), [(name.replace("_", " "), value) for name, value in conditions.items()])

"""Read the tables of README and pages."""

from __future__ import annotations

from pathlib import Path

ROOT = Path(__file__).parents[2]


def table_rows(page: str, first: str, heads: bool = False) -> list[list[str]]:
    """Return the cells of the rows of each table of a page whose first line begins with `first`.

    heads: with that line of each table.
    """
    lines = [line.strip() for line in (ROOT / page).read_text().splitlines()]
    rows = []
    for head, line in enumerate(lines):
        if line.startswith(first):
            end = next((k for k in range(head, len(lines)) if not lines[k].startswith("|")), len(lines))
            names, _, *body = ([cell.strip() for cell in row[1:-1].split("|")] for row in lines[head:end])
            rows += [names, *body] if heads else body
    assert rows, first
    return rows

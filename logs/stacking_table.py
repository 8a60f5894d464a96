"""Console tables that are never truncated: if a row does not fit, its cells go on separate lines."""

from __future__ import annotations

import os
from collections.abc import Iterable, Sequence
from typing import Any

from rich.console import Console, ConsoleOptions, RenderableType, RenderResult
from rich.table import Table
from rich.text import Text

PLAIN: dict[str, Any] = {"box": None, "padding": (0, 2, 0, 0)}
UNLIMITED = 10_000  # columns


class StackingTable(Table):
    """A rich table that is never truncated (rich itself cuts or wraps cells).

    If the table is wider than the terminal, each row becomes a block of `column: cell` lines. A file has no width
    limit unless $COLUMNS sets one.
    """

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        wide = options.update(width=UNLIMITED, max_width=UNLIMITED)
        needed = self.__rich_measure__(console, wide).maximum
        bounded = console.is_terminal or "COLUMNS" in os.environ
        if needed <= options.max_width or not bounded:
            console.width = max(console.width, needed)  # the console truncates wider lines
            yield from super().__rich_console__(console, options.update(width=needed))
        else:
            yield from self._stacked()

    def _stacked(self) -> RenderResult:
        if self.title:
            yield Text.assemble((str(self.title), "italic"))
        heads = [str(column.header) if self.show_header else "" for column in self.columns]
        cells = [list(column.cells) for column in self.columns]
        for row in zip(*cells, strict=True):
            first, *rest = (Text.from_markup(cell) if isinstance(cell, str) else cell for cell in row)
            if not self.show_header:
                yield Text.assemble(first, ": ", *rest)
                continue
            yield Text.assemble((f"{heads[0]}: " if heads[0] else "", "dim"), first)
            for head, cell in zip(heads[1:], rest, strict=True):
                if str(cell):
                    yield Text.assemble((f"  {head}: " if head else "  ", "dim"), cell)
        if self.caption:
            yield Text.assemble((str(self.caption), "dim italic"))


def plain_table(columns: Sequence[str], rows: Iterable[Sequence[RenderableType]]) -> StackingTable:
    """Return a table without lines; without `columns`, rows of a name and a value. Texts are no markup."""
    table = StackingTable(show_header=bool(columns), **PLAIN)
    for column in columns:
        table.add_column(Text(column))  # as markup, the unit in `decision [ms]` would be a style
    for row in rows:
        table.add_row(*(Text(cell) if isinstance(cell, str) else cell for cell in row))
    return table

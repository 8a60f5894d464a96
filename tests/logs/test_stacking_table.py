"""Console tables never truncate a cell, in files and in terminals."""

import pytest

from brakeline.logs.stacking_table import StackingTable, plain_table
from tests.logs.sample_log import printed

CELLS = [f"the cell of column {i}, which is not short" for i in range(6)]


def shown(width=None, **console):
    table = StackingTable(*(f"column {i}" for i in range(6)), title="a title")
    table.add_row(*CELLS)
    return printed(table, width, **console)


def test_a_table_has_its_full_width_in_a_file_and_is_stacked_where_less_is_allowed(monkeypatch):
    monkeypatch.delenv("COLUMNS", raising=False)
    (row,) = (line for line in shown().splitlines() if CELLS[0] in line)
    assert all(cell in row for cell in CELLS)
    for width in (40, 80):
        text = shown(force_terminal=True, width=width, no_color=True)
        assert "column 5:" in text and max(map(len, text.splitlines())) < width + 40  # and colours
    monkeypatch.setenv("COLUMNS", "80")
    assert "column 5:" in shown() and "not short" in shown().replace("\n", " ")


@pytest.mark.parametrize("width", [None, 20])
def test_the_units_of_columns_are_shown(width):
    text = printed(plain_table(("decision [ms]", "speed [m/s]"), [("1.2", "0.25")]), width)
    assert "decision [ms]" in text and "speed [m/s]" in text


@pytest.mark.parametrize("width", [None, 20])
def test_texts_are_no_markup(width):
    """A run may be called `no[filter]`, and a reason of another program may hold anything."""
    cells = "no[filter]", "[/]", ":fire:", "[red]x"
    text = printed(plain_table(tuple("abcd"), [cells]), width)
    assert all(cell in text for cell in cells)

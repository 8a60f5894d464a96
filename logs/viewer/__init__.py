"""Scripts and styles that the report and the live page share: colors, drawing tools, and the viewer of an episode."""

from __future__ import annotations

import re
from functools import cache
from importlib.resources import files

COLORS = "colors.css"
STYLES = (COLORS, "viewer.css")
SCRIPTS = ("three.min.js", "svg.js", "plan.js", "space.js", "plots.js", "viewer.js")  # in the order of their use


def viewer_file(name: str) -> str:
    """Return the text of one of the files."""
    return files(__name__).joinpath(name).read_text(encoding="utf-8")


@cache
def _light_colors() -> dict[str, str]:
    """Return the light colors by name."""
    table = viewer_file(COLORS).split("@media", 1)[0]
    return dict(re.findall(r"--([a-z-]+): (#[0-9a-f]{6});", table))


def hex_color(name: str) -> str:
    """Return a color of the table.

    >>> hex_color("allowed")
    '#2b6cb8'
    """
    return _light_colors()[name]


def rgb_color(name: str) -> tuple[int, int, int]:
    """Return a color of the table as red, green and blue from 0 to 255.

    >>> rgb_color("allowed")
    (43, 108, 184)
    """
    red, green, blue = bytes.fromhex(hex_color(name)[1:])
    return red, green, blue

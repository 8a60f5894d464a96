"""Scripts and styles that the report and the live page share: colors, drawing tools, and the viewer of an episode."""

from importlib.resources import files

COLORS = "colors.css"
STYLES = (COLORS, "viewer.css")
SCRIPTS = ("three.min.js", "svg.js", "plan.js", "space.js", "plots.js", "viewer.js")  # in the order of their use


def viewer_file(name: str) -> str:
    """Return the text of one of the files."""
    return files(__name__).joinpath(name).read_text(encoding="utf-8")

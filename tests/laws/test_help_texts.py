"""Help answers at once, and the help of an option reads as one paragraph.

tyro begins a new line before a line that begins with no letter.
"""

import ast
import itertools
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

DEPLOY = Path(__file__).parents[2] / "deploy"


def _options(tree: ast.AST) -> Iterator[tuple[int, str]]:
    """Yield line and text of each docstring of a field."""
    for node in ast.walk(tree):
        body = node.body if isinstance(node, ast.ClassDef) else []
        for before, after in itertools.pairwise(body):
            if (
                isinstance(before, ast.AnnAssign)
                and isinstance(after, ast.Expr)
                and isinstance(after.value, ast.Constant)
            ):
                yield after.lineno, str(after.value.value)


def test_no_line_of_a_fields_help_begins_without_a_letter():
    broken = [
        f"{path}:{number + i}"
        for path in DEPLOY.rglob("*.py")
        for number, text in _options(ast.parse(path.read_text()))
        for i, line in enumerate(text.split("\n"))
        if i and line.strip() and not line.strip()[0].isalpha()
    ]
    assert not broken


# What takes longer to import than the help may take. Two simulators' commands import MuJoCo for their defaults.
HEAVY = {"numba", "scipy", "mujoco", "torch", "matplotlib", "gymnasium", "proxsuite", "pyarrow"}
SIMULATING = {"autopilot", "bridge-sim"}
IMPORTED = """
import sys
from brakeline.deploy.cli import COMMANDS, command_class
for name in COMMANDS:
    if name not in {simulating!r}:
        command_class(name)
        found = sys.modules.keys() & {heavy!r}
        assert not found, f"{{name}} imports {{found}} before it runs"
"""


def test_no_command_imports_anything_heavy_before_it_runs():
    text = IMPORTED.format(simulating=SIMULATING, heavy=HEAVY)
    done = subprocess.run([sys.executable, "-c", text], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr

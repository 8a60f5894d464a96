"""The help of an option reads as one paragraph: tyro begins a new line before a line that begins with no letter."""

import ast
import itertools
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

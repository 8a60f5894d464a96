"""Help answers at once, and the help of an option reads as one paragraph."""

import ast
import itertools
import os
import re
import subprocess
import sys
import warnings
from collections.abc import Iterator
from pathlib import Path

import pytest
import tyro

from brakeline.deploy.cli import COMMANDS, command_class, main, registry
from brakeline.deploy.commands.completion_command import completion

DEPLOY = Path(__file__).parents[2] / "deploy"


def _options(tree: ast.AST) -> Iterator[str]:
    """Yield each docstring of a field."""
    for node in ast.walk(tree):
        body = node.body if isinstance(node, ast.ClassDef) else []
        for before, after in itertools.pairwise(body):
            if (
                isinstance(before, ast.AnnAssign)
                and isinstance(after, ast.Expr)
                and isinstance(after.value, ast.Constant)
            ):
                yield str(after.value.value)


def options_of(name: str) -> dict[str, str]:
    """Return the help of each option of a command, by its name."""
    command = command_class(name)
    defaults = {"default": command.defaults([])} if hasattr(command, "defaults") else {}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)  # tyro has no other way to list the options
        parser = tyro.extras.get_parser(command, registry=registry, **defaults)
    named = {"/".join(action.option_strings) or action.dest: action.help or "" for action in parser._actions}
    del named["-h/--help"]
    return named


# What takes longer to import than the help may take. Two simulators' commands import MuJoCo for their defaults.
HEAVY = {"numba", "scipy", "mujoco", "torch", "matplotlib", "gymnasium", "proxsuite", "pyarrow"}
SIMULATING = {"autopilot", "bridge-sim"}
HELP = f"""
import sys
from contextlib import suppress
from brakeline.deploy.cli import COMMANDS, command_class, main
for name in COMMANDS.keys() - {SIMULATING!r}:
    command_class(name)
    heavy = sys.modules.keys() & {HEAVY!r}
    assert not heavy, f"{{name}} imports {{heavy}} before it runs"
for name in COMMANDS:
    with suppress(SystemExit):
        main([name, "--help-all"])
"""


def test_help_imports_nothing_heavy_and_has_no_line_break_of_the_source():
    wide = os.environ | {"COLUMNS": "3000"}
    done = subprocess.run([sys.executable, "-c", HELP], env=wide, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    texts = [
        " ".join(text.split())
        for path in (DEPLOY / "commands").glob("*.py")
        for text in _options(ast.parse(path.read_text()))
        if "\n" in text
    ]
    assert len(texts) > 50 and [text for text in texts if text not in done.stdout] == []


@pytest.mark.parametrize("name", COMMANDS)
def test_every_option_has_a_sentence(name):
    for option, text in options_of(name).items():
        sentence = re.sub(r"\s*\((default: .*|required)\)$", "", text, flags=re.DOTALL)
        assert sentence[:1].isupper() and sentence.endswith((".", ".)")), f"{name} {option}: {text!r}"


def test_work_that_shows_progress_can_be_quiet():
    showing = {path for path in (DEPLOY / "commands").glob("*_command.py") if "under_way(" in path.read_text()}
    assert showing and all("quiet: " in path.read_text() for path in showing)


def test_a_missing_value_is_never_called_by_its_python_type(capsys):
    with pytest.raises(SystemExit) as ended:
        main(["certify", "--accept-bound", "much"])
    said = capsys.readouterr().err
    assert ended.value.code == 2 and "--accept-bound FLOAT" in said and "None" not in said


@pytest.mark.parametrize("shell", ["bash", "zsh"])
def test_the_shells_complete_every_command(shell):
    text = completion(shell)
    assert all(name in text for name in COMMANDS) and "--accept-bound" in text

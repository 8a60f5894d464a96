"""Test the help of the command line, and the answers to typing errors."""

import os
import re
import shlex
import subprocess
import sys

import pytest

from brakeline.deploy.cli import COMMANDS, command_class, main

# --- help and typing errors --------------------------------------------------------------------------------------


def test_the_overview_has_every_command_with_an_example(command):
    status, out, _ = command("--help")
    assert status == 0
    for name, entry in COMMANDS.items():
        assert name in out and entry.example.split(" --")[0] in out
    assert command()[0] == 2


@pytest.mark.parametrize("name", COMMANDS)
def test_help_shows_the_example_and_ends_with_0(command, name):
    status, out, err = command(name, "--help")
    assert status == 0 and err == ""
    assert f"Example: {COMMANDS[name].example}" in " ".join(out.split())


@pytest.mark.parametrize("words", ["robot new", "query ground", "keys keys safety", "train quadrotor"])
def test_help_after_positional_arguments_is_the_help_of_the_command(command, words):
    assert (
        command(*words.split(), "--help")[1].splitlines()[0] == command(words.split()[0], "--help")[1].splitlines()[0]
    )


@pytest.mark.parametrize("name", COMMANDS)
def test_every_example_is_understood(name, monkeypatch):
    understood = []
    monkeypatch.setattr(command_class(name), "run", lambda self: understood.append(self) or 0)
    assert main(shlex.split(COMMANDS[name].example)[1:]) == 0 and understood


@pytest.mark.parametrize("columns", ["0", "5"])
@pytest.mark.parametrize("words", [["--help"], ["status", "--help"], ["robot", "show", "ground"]])
def test_a_terminal_without_width_shows_everything(columns, words):
    """Before, the first and the last printed nothing, or the help of a command did not end."""
    script = f"import sys; from brakeline.deploy.cli import main; sys.exit(main({words}))"
    environment = os.environ | {"COLUMNS": columns}
    done = subprocess.run(
        [sys.executable, "-c", script], check=False, capture_output=True, text=True, timeout=60, env=environment
    )
    assert done.returncode == 0 and len(done.stdout) > 400, done.stderr


def test_a_typing_error_is_answered_with_a_suggestion(command):
    status, out, err = command("evalute", "ground")
    assert (status, out) == (2, "") and "did you mean `evaluate`?" in err
    status, out, err = command("evaluate", "ground", "--episods", 3)
    assert (status, out) == (2, "") and "--episodes" in err


def test_help_and_typing_errors_import_nothing_heavy():
    script = """
import contextlib, sys
from brakeline.deploy.cli import main
heavy = ("torch", "mujoco", "zenoh", "scipy", "numpy", "pymavlink", "proxsuite", "google.protobuf", "pydantic")
for words in (["train", "--help"], ["train", "--stps", "3"], ["--version"]):
    try:
        status = main(words)
    except SystemExit as end:
        status = end.code
    print("loaded:", status, [name for name in heavy if name in sys.modules])
"""
    done = subprocess.run([sys.executable, "-c", script], check=False, capture_output=True, text=True, timeout=60)
    lines = done.stdout.splitlines()
    assert [line for line in lines if line.startswith("loaded")] == [f"loaded: {n} []" for n in (0, 2, 0)], done.stderr
    assert re.fullmatch(r"brakeline \d+\.\d+\S*", lines[-2])


def test_help_shows_the_common_options_and_help_all_shows_all(command, monkeypatch):
    monkeypatch.setenv("COLUMNS", "80")
    status, short, _ = command("train", "--help")
    rows = short.splitlines()
    first, second = (
        next(k for k, row in enumerate(rows) if word in row) for word in ("-h, --help", "filtering options")
    )
    assert status == 0 and 8 < second - first <= 24, "a screen"
    for option in ("--steps", "--seed", "--actors", "--method", "--resume", "--help-all"):
        assert option in short
    assert "--learner.td3.batch" not in short and "--rotation" not in short
    status, whole, _ = command("train", "--help-all")
    assert status == 0
    for option in ("--steps", "--learner.td3.batch", "--rotation.mib", "--payload", "--deterministic"):
        assert option in whole
    assert command("train", "--payload", "heavy")[0] == 2, "what is not shown is understood all the same"

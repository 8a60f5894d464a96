"""Run a program of the examples as a person starts it."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

EXAMPLES = Path(__file__).parents[2] / "examples"


def python_of(folder: str) -> Path:
    """Return the interpreter of an example's virtual environment. Skips the test where there is none."""
    python = EXAMPLES / folder / ".venv" / "bin" / "python"
    if not python.exists():
        pytest.skip(f"{folder} has no virtual environment: make {folder.replace('_', '-')}")
    return python


def run_program(name: str, *words: object, python: str | Path = sys.executable, timeout: float | None = 300.0) -> str:
    """Return what a program below `examples/` prints."""
    alone = {name: value for name, value in os.environ.items() if name != "PYTHONSAFEPATH"} | {"OMP_NUM_THREADS": "1"}
    call = [*map(str, (python, EXAMPLES / name, *words))]
    ran = subprocess.run(call, env=alone, capture_output=True, text=True, timeout=timeout, check=False)
    assert ran.returncode == 0, ran.stderr
    return ran.stdout

"""Run a program of the examples as a person starts it."""

import os
import subprocess
import sys
from pathlib import Path

EXAMPLES = Path(__file__).parents[2] / "examples"


def run_program(name: str, *words: str) -> str:
    """Return what a program below `examples/` prints."""
    alone = {name: value for name, value in os.environ.items() if name != "PYTHONSAFEPATH"} | {"OMP_NUM_THREADS": "1"}
    call = [sys.executable, str(EXAMPLES / name), *words]
    ran = subprocess.run(call, env=alone, capture_output=True, text=True, timeout=300, check=False)
    assert ran.returncode == 0, ran.stderr
    return ran.stdout

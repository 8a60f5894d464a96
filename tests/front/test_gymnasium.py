"""An import registers the environments with Gymnasium. `tests/sim/test_navigation_env.py` makes them by their names."""

import subprocess
import sys

import pytest


@pytest.mark.parametrize(
    "code",
    [
        "import gymnasium, brakeline; gymnasium.make('brakeline/Ground-v0')",
        "import gymnasium; gymnasium.make('brakeline.envs:brakeline/Quadrotor-v0')",
    ],
)
def test_a_program_registers_them_by_an_import(code):
    subprocess.run([sys.executable, "-c", code], check=True, capture_output=True)

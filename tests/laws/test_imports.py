"""Imports keep to the allow-lists of `tests/laws/imports.py`, and a violation that is planted is found."""

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

from tests.laws.imports import violations

ROOT = Path(__file__).parents[2]


def test_every_import_is_allowed():
    assert violations() == []


# A module, a line to add to it, and the import that breaks a rule.
PLANTED = [
    ("actors/decision_guard.py", "import brakeline.safety.filter.constraints", "safety.filter.constraints"),
    ("actors/episode_runner.py", "from brakeline.safety.filter import qp_solver", "safety.filter.qp_solver"),
    ("logs/reader.py", "import brakeline.sim.arena", "sim.arena"),
    ("learner/learner.py", "import brakeline.logs.reader", "logs.reader"),
    ("safety/filter/filter.py", "import brakeline.actors.proposers", "actors.proposers"),
    ("sim/arena.py", "import brakeline.safety.filter.filter", "safety.filter.filter"),
    ("messaging/robot.py", "def late():\n    import brakeline.sim.arena", "sim.arena"),
    ("messaging/process_runtime.py", "import zenoh", "zenoh"),
    ("actors/proposers.py", "import torch", "torch"),
    ("deploy/commands/fly_command.py", "from pymavlink import mavutil", "pymavlink"),
    ("safety/filter/filter.py", "import mujoco", "mujoco"),
    ("messaging/topics.py", "import requests", "requests"),
    ("actors/proposers.py", "from brakeline import Filter", "the public names"),
]


def test_every_planted_violation_is_found(tmp_path):
    """Plant all of them in a copy of the package: the program prints one line for each, and no other."""
    shutil.copytree(ROOT / "brakeline", tmp_path / "brakeline", ignore=shutil.ignore_patterns("__pycache__"))
    shutil.copytree(ROOT / "tests" / "laws", tmp_path / "tests" / "laws")
    for file, line, _ in PLANTED:
        with (tmp_path / "brakeline" / file).open("a") as module:
            module.write(f"\n\n{line}\n")
    command = [sys.executable, "-P", str(tmp_path / "tests" / "laws" / "imports.py")]
    clean = os.environ | {"PYTHONPATH": str(tmp_path)}
    run = subprocess.run(command, check=False, capture_output=True, text=True, env=clean, cwd=tmp_path)
    expected = [f"{file.removesuffix('.py').replace('/', '.')} imports {imported}" for file, _, imported in PLANTED]
    assert run.returncode == 1, run.stdout + run.stderr
    assert sorted(re.split("[,:]", line)[0] for line in run.stdout.splitlines()) == sorted(expected)

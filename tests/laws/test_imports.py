"""Imports keep to the allow-lists of `tests/laws/imports.py`, and a violation that is planted is found."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from tests.laws.imports import violations

ROOT = Path(__file__).parents[2]


def test_every_import_is_allowed():
    assert violations() == []


PLANTED = {
    "an actor that looks into the filter": ("actors/decision_guard.py", "import brakeline.safety.filter.constraints"),
    "an actor that solves the QP": ("actors/episode_runner.py", "from brakeline.safety.filter import qp_solver"),
    "a log reader that drives the simulator": ("logs/reader.py", "import brakeline.sim.arena"),
    "a learner that reads logs": ("learner/learner.py", "import brakeline.logs.reader"),
    "safety that knows of actors": ("safety/filter/filter.py", "import brakeline.actors.policies"),
    "a simulator that knows of the filter": ("sim/arena.py", "import brakeline.safety.filter.filter"),
    "the vocabulary that knows of a part": ("messaging/robot.py", "def late():\n    import brakeline.sim.arena"),
    "Zenoh outside the bus": ("messaging/process_runtime.py", "import zenoh"),
    "Torch outside the learner": ("actors/policies.py", "import torch"),
    "pymavlink inside": ("deploy/commands/fly_command.py", "from pymavlink import mavutil"),
    "MuJoCo in the filter": ("safety/filter/filter.py", "import mujoco"),
    "a package that no list names": ("messaging/topics.py", "import requests"),
    "a part that imports the public names": ("actors/policies.py", "from brakeline import Filter"),
}


@pytest.fixture(scope="module")
def copy(tmp_path_factory):
    """Copy the package to a folder where it may be broken."""
    folder = tmp_path_factory.mktemp("planted")
    shutil.copytree(
        ROOT / "brakeline", folder / "brakeline", ignore=lambda _, names: [n for n in names if n == "__pycache__"]
    )
    shutil.copytree(ROOT / "tests" / "laws", folder / "tests" / "laws")
    return folder


@pytest.mark.parametrize("what", PLANTED)
def test_a_planted_violation_is_found(copy, what):
    file, line = PLANTED[what]
    module = copy / "brakeline" / file
    before = module.read_text()
    module.write_text(f"{before}\n\n{line}\n")
    try:
        words = [sys.executable, "-P", str(copy / "tests" / "laws" / "imports.py")]
        clean = os.environ | {"PYTHONPATH": str(copy)}
        found = subprocess.run(words, check=False, capture_output=True, text=True, env=clean, cwd=copy)
    finally:
        module.write_text(before)
    importer = file.removesuffix(".py").replace("/", ".")
    assert found.returncode == 1 and found.stdout.startswith(f"{importer} imports "), found.stdout + found.stderr
    assert len(found.stdout.splitlines()) == 1

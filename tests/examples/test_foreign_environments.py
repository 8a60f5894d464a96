"""A minute of other people's environments, in their own virtual environments, where those were set up."""

import json
import os
import subprocess
from pathlib import Path

import pytest

from deploy.data.store import certified
from messaging.bus import Bus, BusSettings
from messaging.ports import free_endpoint
from messaging.topics import DECIDE
from safety.dataset import Dataset
from safety.model_set import Recipe
from safety.service import Counts, Models, answerer

EXAMPLES = Path(__file__).parents[2] / "examples"


def python_of(name):
    python = EXAMPLES / name / ".venv" / "bin" / "python"
    if not python.exists():
        pytest.skip(f"{name} has no virtual environment: make {name.replace('_', '-')}")
    return python


def told(python, script, *words):
    """The last line that a script printed."""
    run = subprocess.run(
        [python, script, *words], check=False, capture_output=True, text=True, env=os.environ | {"OMP_NUM_THREADS": "1"}
    )
    assert run.returncode == 0, run.stderr
    return run.stdout.strip().splitlines()[-1]


def test_the_car_costs_nothing_behind_a_filter_of_its_own_data(tmp_path):
    folder = EXAMPLES / "safety_gymnasium"
    python = python_of("safety_gymnasium")
    record = tmp_path / "car.safetensors"
    told(python, folder / "collect.py", "car", str(record), "6000")
    models = Models()
    models.install(certified(Dataset.load(record), Recipe())[0])
    endpoint = free_endpoint()
    with Bus(BusSettings(listen=(endpoint,)), "safety") as bus:
        bus.serve(DECIDE, answerer(models, Counts()))
        said = told(
            python, folder / "run.py", "car", "adversarial", "--episodes", "1", "--steps", "300", "--connect", endpoint
        )
    figures = json.loads(said)
    assert figures["cost"] == 0.0 and figures["steps"] == 300
    assert set(figures["decisions"]) <= {"allowed", "adjusted", "failsafe"} and figures["decisions"]["adjusted"] > 30

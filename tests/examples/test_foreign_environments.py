"""A minute of other authors' environments, in their own virtual environments, where those were set up."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from deploy.data.certified import certified
from examples.foreign import table
from messaging.bus import Bus, BusSettings
from messaging.ports import free_endpoint
from messaging.topics import DECIDE
from safety.dataset import Dataset
from safety.model_set import Recipe
from safety.service import Counts, Models, answerer

EXAMPLES = Path(__file__).parents[2] / "examples"


def python_of(folder):
    python = EXAMPLES / folder / ".venv" / "bin" / "python"
    if not python.exists():
        pytest.skip(f"{folder} has no virtual environment: make {folder.replace('_', '-')}")
    return python


def told(python, script, *words):
    """The last line that a script printed."""
    run = subprocess.run(
        [python, EXAMPLES / "foreign" / script, *words],
        check=False,
        capture_output=True,
        text=True,
        env=os.environ | {"OMP_NUM_THREADS": "1"},
    )
    assert run.returncode == 0, run.stderr
    return run.stdout.strip().splitlines()[-1]


def test_who_asks_and_records_needs_no_solver_and_no_simulator():
    """Their virtual environments have neither."""
    missing = "import sys; sys.modules |= dict.fromkeys(('proxsuite', 'scipy', 'torch', 'mcap'))"
    needed = "import safety.client, safety.gym, deploy.data.episodes"
    subprocess.run([sys.executable, "-c", f"{missing}; {needed}"], check=True, cwd=EXAMPLES.parent)


@pytest.mark.parametrize(
    ("robot", "folder", "periods"), [("car", "safety_gymnasium", 9000), ("racecar", "bullet_safety_gym", 12000)]
)
def test_driving_at_hazards_costs_nothing_behind_a_filter_of_own_data(tmp_path, robot, folder, periods):
    python = python_of(folder)
    record, lines = tmp_path / f"{robot}.safetensors", tmp_path / "lines.jsonl"
    told(python, "collect.py", robot, str(record), str(periods))
    models = Models()
    models.install(certified(Dataset.load(record), Recipe())[0])
    endpoint = free_endpoint()
    words = [robot, "adversarial", "--seeds", "0", "1", "--steps", "300"]
    with Bus(BusSettings(listen=(endpoint,)), "safety") as bus:
        bus.serve(DECIDE, answerer(models, Counts()))
        said = told(python, "run.py", *words, "--connect", endpoint, "--out", str(lines))
    figures = json.loads(said)
    assert figures["cost"] == 0.0 and figures["steps"] == 300
    assert set(figures["decisions"]) <= {"allowed", "adjusted", "failsafe"} and figures["decisions"]["allowed"] < 270
    assert json.loads(lines.read_text()) == figures


def test_the_table_adds_up_pieces_and_counts_a_seed_once(tmp_path, capsys):
    def line(seed, cost, **decisions):
        told = {"robot": "car", "policy": "random", "filter": bool(decisions), "seed": seed, "steps": 100, "cost": cost}
        return told | {"reward": 1.0, "decisions": decisions, "unverified": 0, "outside": 5}

    pieces = (
        [line(0, 0.0, allowed=100), line(1, 3.0, allowed=40, adjusted=60)],
        [line(1, 3.0, adjusted=100), line(2, 7)],
    )
    paths = [tmp_path / "a.jsonl", tmp_path / "b.jsonl"]
    for path, lines in zip(paths, pieces, strict=True):
        path.write_text("".join(json.dumps(one) + "\n" for one in lines))
    table.main(*map(str, paths))
    bare, filtered = (line.split(" | ") for line in capsys.readouterr().out.splitlines()[2:])
    assert bare[2:6] == ["no", "1", "7.0", "7"]
    assert filtered[2:6] == ["yes", "2", "1.5", "3"]
    assert filtered[8:] == ["10 of 200 (5.0%)", "100 allowed, 100 adjusted |"]

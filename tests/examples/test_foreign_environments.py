"""A minute of other authors' environments, in their own virtual environments, where those were set up."""

import dataclasses
import json
import os
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from brakeline.deploy.data.certification import certify
from brakeline.messaging.bus import Bus, BusSettings
from brakeline.messaging.free_ports import free_endpoint
from brakeline.messaging.obstacle import Obstacle
from brakeline.messaging.robot import robot_named
from brakeline.messaging.topics import DECIDE
from brakeline.safety.model.dataset import Dataset
from brakeline.safety.model.model_set import ModelConfig
from brakeline.safety.service.server import ModelRegistry, ServiceCounts, batch_handler
from examples.foreign import table, train
from examples.foreign.run import missing
from examples.foreign.trained import Trained, scale
from examples.foreign.ways import Ways
from tests.accepting import BOUND

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
    needed = "import brakeline.safety.service.client, brakeline.safety.gym, brakeline.deploy.data.environment_episodes"
    subprocess.run([sys.executable, "-c", f"{missing}; {needed}"], check=True, cwd=EXAMPLES.parent)


@pytest.mark.parametrize(
    ("robot", "folder", "periods"), [("car", "safety_gymnasium", 9000), ("racecar", "bullet_safety_gym", 12000)]
)
def test_driving_at_hazards_costs_nothing_behind_a_filter_of_own_data(tmp_path, robot, folder, periods):
    python = python_of(folder)
    record, lines = tmp_path / f"{robot}.safetensors", tmp_path / "lines.jsonl"
    told(python, "collect.py", robot, str(record), str(periods))
    models = ModelRegistry(accept_bound=BOUND)
    models.install(certify(Dataset.load(record), ModelConfig())[0])
    endpoint = free_endpoint()
    words = [robot, "adversarial", "--seeds", "0", "1", "--steps", "300"]
    with Bus(BusSettings(listen=(endpoint,)), "safety") as bus:
        bus.serve(DECIDE, batch_handler(models, ServiceCounts()))
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


def test_a_run_goes_on_from_the_seeds_that_are_missing(tmp_path):
    lines = [
        {"robot": "car", "policy": "goal", "filter": filtered, "seed": seed}
        for filtered, seed in [(1, 0), (0, 1), (1, 3)]
    ]
    out = tmp_path / "car.jsonl"
    out.write_text("".join(json.dumps(line) + "\n" for line in lines))
    given = SimpleNamespace(robot="car", policy="goal", seeds=(0, 5), out=out)
    assert missing(given, True) == [1, 2, 4]


def test_a_way_leads_to_the_goal_through_the_gap_and_out_of_a_disc():
    """A row of discs with one gap; the first place is within a disc."""
    robot = SimpleNamespace(footprint=1.0)
    discs = [
        Obstacle("cylinder", (0.0, y), (1.0,), margin=-1.0) for y in (-7.5, -6.0, -4.5, -3.0, 1.5, 3.0, 4.5, 6.0, 7.5)
    ]
    ways = Ways(SimpleNamespace(robot=robot, room=8.0), discs, (6.0, 6.0))
    here, seen = np.array([-0.8, 6.0]), []
    while np.hypot(*(here - (6.0, 6.0))) > 0.5 and len(seen) < 400:
        ahead = ways.ahead(here)
        here = here + 0.1 * (ahead - here) / np.linalg.norm(ahead - here)
        seen.append(min(np.hypot(*(here - disc.position)) for disc in discs))
    assert len(seen) < 400, "it never came there"
    assert min(seen[10:]) >= 0.7, "looking ahead cuts corners, and no more"


def test_a_trained_policy_is_the_same_when_it_is_loaded(tmp_path):
    robot, rng = robot_named(str(EXAMPLES / "safety_gymnasium" / "point.toml")), np.random.default_rng(0)
    seen = rng.normal(3.0, 2.0, (200, 4))
    layers = [(rng.normal(size=(8, 4)), rng.normal(size=8)), (9.0 * rng.normal(size=(2, 8)), rng.normal(size=2))]
    policy = Trained(robot, [(w.astype(np.float32), b.astype(np.float32)) for w, b in layers], *scale(seen))
    path = tmp_path / "point.trained.safetensors"
    policy.save(path, {"steps": 7})
    again = Trained.load(path, robot)
    asked = np.array([policy(row) for row in seen])
    np.testing.assert_array_equal([again(row) for row in seen], asked)
    assert (asked >= robot.low()).all() and (asked <= robot.high()).all()
    assert np.ptp(asked, axis=0) == pytest.approx(robot.high() - robot.low(), rel=0.1), "it uses their whole range"
    assert json.loads((tmp_path / "point.trained.json").read_text()) == {"steps": 7}


class Corrected:
    """Whatever is proposed, nothing is done; 30 steps of cost 1, reward 1 and penalty 0.5."""

    def reset(self, seed):
        self.left, self.rng = 30, np.random.default_rng(seed)
        return self.rng.normal(size=3), {}

    def step(self, control):
        self.left -= 1
        told = {"executed": np.zeros(2), "kind": "adjusted", "verified": True, "contained": True}
        info = {"cost": 1.0, "penalty": 0.5, "diagnostics": told}
        return self.rng.normal(size=3), 1.0 - 0.5, False, self.left == 0, info


def test_training_learns_from_what_was_executed_and_from_what_was_proposed(monkeypatch):
    small = dataclasses.replace(train.CONFIG, hidden=(8, 8), batch=8, warmup=20, n_step=1)
    monkeypatch.setattr(train, "CONFIG", small)
    robot = robot_named(str(EXAMPLES / "safety_gymnasium" / "point.toml"))
    pupil = train.LearnedPolicy(SimpleNamespace(robot=robot), size=3, steps=30, seed=0)
    told = train.episode(Corrected(), pupil, 0).told()
    assert (told["steps"], told["cost"], told["reward"]) == (30, 30.0, 30.0)
    stored = pupil.replay.state().tensors
    executed, proposed = stored["action"][0::2], stored["action"][1::2]
    assert len(executed) == len(proposed) == 30
    assert (executed == 0.0).all() and (np.abs(proposed).max(axis=1) > 0.0).all()
    assert stored["reward"][0::2] == pytest.approx(1.0), "of what was executed: without the penalty"
    assert stored["reward"][1::2] == pytest.approx(0.5)
    assert pupil.policy is not None and pupil.td3.updates > 10
    assert np.abs(pupil.proposed(np.ones(3))).max() <= 1.0

"""A minute in other authors' environments, where they are installed; and the programs that drive there."""

import dataclasses
import json
import subprocess
import sys
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
from brakeline.safety.service.server import BatchHandler, ModelRegistry, ServiceCounts
from examples.foreign import table, train
from examples.foreign.adapter import Adapter
from examples.foreign.distance_field import DistanceField
from examples.foreign.run import missing_seeds
from examples.foreign.trained import TrainedPolicy, mean_and_spread
from tests.accepting import BOUND
from tests.examples.programs import EXAMPLES, python_of, run_program

POINT = robot_named(str(EXAMPLES / "safety_gymnasium" / "point.toml"))


def test_a_client_and_a_recorder_need_no_solver_and_no_simulator():
    """The authors' virtual environments have neither."""
    hide = "import sys; sys.modules |= dict.fromkeys(('proxsuite', 'scipy', 'torch', 'mcap'))"
    needed = "import brakeline.safety.service.client, brakeline.safety.gym, brakeline.deploy.data.environment_episodes"
    subprocess.run([sys.executable, "-c", f"{hide}; {needed}"], check=True, cwd=EXAMPLES.parent)


def test_an_action_that_is_not_finite_reaches_the_filter():
    given = np.array([np.inf, np.nan])
    mapping = Adapter.actions(SimpleNamespace(robot=POINT))
    assert np.array_equal(mapping.action_to_control(given), given, equal_nan=True)
    assert (mapping.action_to_control(np.full(2, 99.0)) == POINT.high()).all()


@pytest.mark.parametrize(
    ("robot", "folder", "periods"), [("car", "safety_gymnasium", 9000), ("racecar", "bullet_safety_gym", 12000)]
)
def test_behind_the_filter_driving_at_hazards_costs_nothing(tmp_path, robot, folder, periods):
    python = python_of(folder)
    record, lines = tmp_path / f"{robot}.safetensors", tmp_path / "lines.jsonl"
    run_program("foreign/collect.py", robot, record, periods, python=python, timeout=None)
    models = ModelRegistry(accept_bound=BOUND)
    models.install(certify(Dataset.load(record), ModelConfig())[0])
    endpoint = free_endpoint()
    words = [robot, "adversarial", "--seeds", "0", "1", "--steps", "300"]
    with Bus(BusSettings(listen=(endpoint,)), "safety") as bus:
        bus.serve(DECIDE, BatchHandler(models, ServiceCounts()))
        words += ["--connect", endpoint, "--out", lines]
        printed = run_program("foreign/run.py", *words, python=python, timeout=None)
    figures = json.loads(printed.strip().splitlines()[-1])
    assert figures["cost"] == 0.0 and figures["steps"] == 300
    assert set(figures["decisions"]) <= {"allowed", "adjusted", "failsafe"} and figures["decisions"]["allowed"] < 270
    assert json.loads(lines.read_text()) == figures


def test_the_table_adds_up_files_and_counts_each_seed_once(tmp_path, capsys):
    def line(seed, cost, **decisions):
        about = {"robot": "car", "policy": "random", "filter": bool(decisions), "seed": seed, "steps": 100}
        return about | {"cost": cost, "reward": 1.0, "decisions": decisions, "unverified": 0, "outside": 5}

    files = {
        tmp_path / "a.jsonl": [line(0, 0.0, allowed=100), line(1, 3.0, allowed=40, adjusted=60)],
        tmp_path / "b.jsonl": [line(1, 3.0, adjusted=100), line(2, 7)],
    }
    for path, lines in files.items():
        path.write_text("".join(json.dumps(line) + "\n" for line in lines))
    table.main(*map(str, files))
    without, filtered = (line.split(" | ") for line in capsys.readouterr().out.splitlines()[2:])
    assert without[2:6] == ["no", "1", "7.0", "7"]
    assert filtered[2:6] == ["yes", "2", "1.5", "3"]
    assert filtered[8:] == ["10 of 200 (5.0%)", "100 allowed, 100 adjusted |"]


def test_a_run_goes_on_from_the_missing_seeds(tmp_path):
    out, about = tmp_path / "car.jsonl", {"robot": "car", "policy": "goal"}
    lines = [about | {"filter": filtered, "seed": seed} for filtered, seed in [(1, 0), (0, 1), (1, 3)]]
    out.write_text("".join(json.dumps(line) + "\n" for line in lines))
    options = SimpleNamespace(robot="car", policy="goal", seeds=(0, 5), out=out)
    assert missing_seeds(options, True) == [1, 2, 4]


def test_the_path_leads_to_the_goal_through_the_gap_and_out_of_a_disc():
    """A row of discs has one gap; the path begins within a disc."""
    row = (-7.5, -6.0, -4.5, -3.0, 1.5, 3.0, 4.5, 6.0, 7.5)
    discs = [Obstacle("cylinder", (0.0, y), (1.0,), margin=-1.0) for y in row]
    adapter = SimpleNamespace(robot=SimpleNamespace(footprint=1.0), half_width=8.0)
    field = DistanceField(adapter, discs, (6.0, 6.0))
    position, distances = np.array([-0.8, 6.0]), []
    while np.hypot(*(position - (6.0, 6.0))) > 0.5 and len(distances) < 400:
        ahead = field.ahead(position)
        position = position + 0.1 * (ahead - position) / np.linalg.norm(ahead - position)
        distances.append(min(np.hypot(*(position - disc.position)) for disc in discs))
    assert len(distances) < 400, "the path does not lead to the goal"
    assert min(distances[10:]) >= 0.7, "the lookahead only cuts corners"


def test_a_trained_policy_is_the_same_after_loading(tmp_path):
    rng = np.random.default_rng(0)
    observations = rng.normal(3.0, 2.0, (200, 4))
    layers = [(rng.normal(size=(8, 4)), rng.normal(size=8)), (9.0 * rng.normal(size=(2, 8)), rng.normal(size=2))]
    weights = [(w.astype(np.float32), b.astype(np.float32)) for w, b in layers]
    policy = TrainedPolicy(POINT, weights, *mean_and_spread(observations))
    path = tmp_path / "point.trained.safetensors"
    policy.save(path, {"steps": 7})
    loaded = TrainedPolicy.load(path, POINT)
    inputs = np.array([policy(row) for row in observations])
    np.testing.assert_array_equal([loaded(row) for row in observations], inputs)
    assert (inputs >= POINT.low()).all() and (inputs <= POINT.high()).all()
    assert np.ptp(inputs, axis=0) == pytest.approx(POINT.high() - POINT.low(), rel=0.1), "it uses the whole range"
    assert json.loads((tmp_path / "point.trained.json").read_text()) == {"steps": 7}


class CorrectingEnv:
    """Replaces every action by zero, for 30 steps of cost 1, reward 1 and penalty 0.5."""

    def reset(self, seed):
        self.left, self.rng = 30, np.random.default_rng(seed)
        return self.rng.normal(size=3), {}

    def step(self, control):
        self.left -= 1
        decision = {"executed": np.zeros(2), "kind": "adjusted", "verified": True, "contained": True}
        info = {"cost": 1.0, "penalty": 0.5, "diagnostics": decision}
        return self.rng.normal(size=3), 1.0 - 0.5, False, self.left == 0, info


def test_training_learns_from_executed_and_from_proposed_actions(monkeypatch):
    small = dataclasses.replace(train.CONFIG, hidden=(8, 8), batch=8, warmup=20, n_step=1)
    monkeypatch.setattr(train, "CONFIG", small)
    learner = train.Learner(SimpleNamespace(robot=POINT), size=3, steps=30, seed=0)
    figures = train.episode(CorrectingEnv(), learner, 0)
    assert (figures.steps, figures.cost, figures.reward) == (30, 30.0, 30.0)
    stored = learner.replay.state().tensors
    executed, proposed = stored["action"][0::2], stored["action"][1::2]
    assert len(executed) == len(proposed) == 30
    assert (executed == 0.0).all() and (np.abs(proposed).max(axis=1) > 0.0).all()
    net = stored["reward"] - stored["penalty"]
    assert net[0::2] == pytest.approx(1.0), "executed actions have no penalty"
    assert net[1::2] == pytest.approx(0.5)
    assert learner.policy is not None and learner.td3.updates > 10
    assert np.abs(learner.propose(np.ones(3))).max() <= 1.0

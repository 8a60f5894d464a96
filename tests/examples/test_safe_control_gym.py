"""examples/safe_control_gym: the velocity loop and the table; and, if the package is installed, a drive of its own."""

import json

import numpy as np
import pytest

from brakeline.deploy.cli import main as brakeline
from examples.safe_control_gym import table
from examples.safe_control_gym.velocity_loop import ROBOT, STRONGEST, force_of, velocity_of
from tests.examples.programs import EXAMPLES, python_of, run_program

FOLDER = EXAMPLES / "safe_control_gym"
CART, POLE, HALF, GRAVITY = 1.0, 0.1, 0.5, 9.8  # kg, kg, m (half the pole), m/s²


def after_period(state, force, steps=50):
    """Return a cart-pole's state after one period of a constant force."""
    step, state = ROBOT.period / steps, np.array(state)
    for _ in range(steps):
        _, speed, tilt, rate = state
        push = (force + POLE * HALF * rate**2 * np.sin(tilt)) / (CART + POLE)
        turn = GRAVITY * np.sin(tilt) - np.cos(tilt) * push
        turn /= HALF * (4.0 / 3.0 - POLE * np.cos(tilt) ** 2 / (CART + POLE))
        state = state + step * np.array([speed, push - POLE * HALF * turn * np.cos(tilt) / (CART + POLE), rate, turn])
    return state


def test_the_description_has_the_constraints_of_the_environment():
    assert brakeline(["robot", "check", str(FOLDER / "cartpole.toml")]) == 0
    assert ROBOT.limit_scales == pytest.approx([2.0, 2.0, 2.0, 2.0, 0.18, 0.18, 2.0, 2.0])
    assert pytest.approx(1.0 / 15.0) == ROBOT.period


def test_a_force_within_reach_comes_back_from_its_velocity():
    for state in np.random.default_rng(0).uniform([-2, -0.5, -0.05, -0.2], [2, 0.5, 0.05, 0.2], (50, 4)):
        for force in (-1.0, 0.0, 2.0):
            assert force_of(state, velocity_of(state, force)) == pytest.approx(force)
    assert velocity_of(np.zeros(4), 100.0) == ROBOT.low()[0], "the cart first moves against a positive force"
    assert abs(force_of(np.array([0.0, 2.0, 0.3, 2.0]), -2.0)) == STRONGEST


def test_no_velocity_balances_the_pole_and_stops_the_cart_within_a_plan():
    state = np.array([0.0, 1.0, 0.0, 0.0])
    for _ in range(ROBOT.horizon):
        state = after_period(state, force_of(state, 0.0))
    assert np.abs(state[1:]).max() < 0.05 and 0.5 < state[0] < 1.0
    free = np.array([0.0, 1.0, 0.01, 0.0])
    for _ in range(ROBOT.horizon):
        free = after_period(free, 0.0)
    assert abs(free[2]) > 0.5, "without the loop the pole falls"


def test_the_table_counts_each_seed_once_and_states_exact_intervals(tmp_path, capsys):
    def line(seed, violations, **changes):
        about = {"disturbed": False, "policy": "ppo", "filter": "brakeline", "amplitude": 1.0, "seed": seed}
        about["steps"] = 150
        figures = {"violations": violations, "fell": False, "corrected": 15, "error": 0.2, "return": 140.0}
        return about | figures | {"outside": 0, "cpu_ms": 1.0, "kinds": {"allowed": 150}} | changes

    lines = [line(seed, 0) for seed in range(100)] + [line(0, 0), line(0, 30, filter="none", kinds={}, fell=True)]
    lines.append(line(0, 0, amplitude=2.3))  # another task, which is no repetition of seed 0
    path = tmp_path / "lines.jsonl"
    path.write_text("".join(json.dumps(one) + "\n" for one in lines))
    table.main(str(path))
    behind, without, far = (one.split(" | ") for one in capsys.readouterr().out.splitlines()[2:])
    assert behind[1:8] == ["ppo", "brakeline", "100", "0 (0.0 to 5.2 %)", "0 of 15000", "0", "10.0%"]
    assert far[1:4] == ["ppo, 2.3 m", "brakeline", "1"]
    assert without[3:8] == ["1", "1 (0.5 to 100.0 %)", "30 of 150", "1", "–"]


def test_no_policy_violates_a_constraint_behind_the_filter(tmp_path, monkeypatch):
    python = python_of(FOLDER.name)
    monkeypatch.setenv("BRAKELINE_DATA", str(tmp_path))

    def run(name, *words):
        printed = run_program(f"{FOLDER.name}/{name}", *words, python=python, timeout=None)
        return [json.loads(one) for one in printed.splitlines() if one.startswith("{")]

    robot, log, model = FOLDER / "cartpole.toml", tmp_path / "drive.csv", "cartpole/residual-one-step.safetensors"
    run("record.py", log, 5)
    assert brakeline(["import", str(log), "--robot", str(robot)]) == 0
    assert brakeline(["certify", str(robot), "--use", "--accept-bound", "0.1"]) == 0
    for policy, amplitude in (("ppo", 1.0), ("lqr", 2.3)):
        words = ["run.py", policy, "--amplitude", amplitude, "--seeds", 0, 2]
        behind = run(*words[:2], "brakeline", *words[2:], "--model", tmp_path / model, "--accept-bound", 0.1)
        without = run(*words[:2], "none", *words[2:])
        assert [one["violations"] for one in behind] == [0, 0] and all(one["steps"] == 150 for one in behind)
        assert sum(one["violations"] for one in without) > 0

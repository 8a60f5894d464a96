"""What the rivals are pre-trained on, and how a threshold is chosen: by its results in closed loop."""

from dataclasses import replace

import numpy as np
import pytest

from brakeline.deploy.data.rival_pretraining import CONFIGS, SailrConfig, SecasConfig, config_for, made_by, pretrain
from brakeline.deploy.data.rival_rollouts import costs, transitions
from brakeline.deploy.experiments import trials
from brakeline.deploy.experiments.evaluate import FRESH
from brakeline.deploy.experiments.tuning_trials import SEED_KEY, best_threshold, try_threshold, values_of
from brakeline.learner.rival_networks import FitConfig
from brakeline.safety.methods import ready
from tests.robots import GROUND, QUADROTOR

LITTLE = {"samples": 300, "fit": FitConfig(hidden=(8,), epochs=1, batch=32)}


def test_transitions_are_whole_scaled_and_the_same_again():
    one, same, other = (transitions(GROUND, SecasConfig(samples=200, seed=seed)) for seed in (1, 1, 2))
    assert one.observation.shape == (200, 26) and one.action.shape == (200, 2) and one.change.shape == (200, 6)
    assert np.array_equal(one.change, same.change) and not np.array_equal(one.change, other.change)
    assert (np.abs(one.action) <= 1.0).all() and (one.action[:, 0] >= 0).all()
    fast = one.action[:, 0] > 0.8
    assert one.change[fast].sum() > one.change[~fast].sum(), "driving ahead brings things nearer"


def test_costs_are_of_braking_to_the_end():
    recorded = costs(GROUND, SailrConfig(samples=1000, seed=1))
    assert recorded.collisions > 0 and recorded.collided.sum() == recorded.collisions
    for cost in (recorded.braked_cost, recorded.step_cost):
        assert (cost >= 0.0).all() and (cost <= 1.0 + 1e-9).all()
    driven = recorded.driven
    assert len(driven) >= 1000 and driven.shape[1] == 28 and (np.abs(driven[:, 26:]) <= 1.0).all()
    quiet = recorded.braked_cost[recorded.braked_cost < 0.5]
    assert quiet.max() < 0.1, "a stop that touched nothing is nearly free, whatever it came near"
    assert len(recorded.braked) == len(recorded.braked_cost) > 150


@pytest.mark.parametrize("config_class", [SecasConfig, SailrConfig])
def test_a_pretrained_model_says_what_it_cost(config_class):
    config = config_class(**LITTLE)
    driven = []
    model = pretrain(GROUND, config, lambda: driven.append(1))
    assert len(driven) >= 300 and ready(model).robot is GROUND
    assert model.about["samples"] == "300" and int(model.about["collisions"]) >= 0 and model.about["error"]
    assert made_by(model, GROUND, config) and not made_by(model, GROUND, config_class())
    older = replace(GROUND, task=replace(GROUND.task, simulator_version=1))
    assert not made_by(model, older, config), "of another simulator"
    assert type(config) is CONFIGS[model.method]


def row(value, oracle, collisions, goals):
    figures = {"oracle_goals": oracle, "greedy_goals": goals, "greedy_collisions": collisions}
    return {"value": value, "episodes": 10, "oracle_interventions": 0.0, **figures}


def test_safety_counts_among_those_that_cost_the_oracle_nothing():
    rows = [row(1.0, 10, 3, 5), row(2.0, 10, 1, 4), row(3.0, 10, 1, 6), row(4.0, 9, 0, 9)]
    assert best_threshold(rows)["value"] == 3.0
    often = row(0.5, 10, 1, 6) | {"oracle_interventions": 0.2}
    assert best_threshold([often, *rows])["value"] == 3.0, "of two alike, the one that leaves A* alone"
    assert best_threshold([row(1.0, 8, 0, 9), row(2.0, 9, 5, 0)])["value"] == 2.0, "the least that any value costs"


def test_a_threshold_that_never_steps_in_and_one_that_always_does():
    model = pretrain(GROUND, SailrConfig(**LITTLE))
    never, always = (try_threshold(model, GROUND, value, 1) for value in (1.0, -1.0))
    assert never["oracle_goals"] == 1 and never["oracle_interventions"] == 0.0
    assert always["oracle_goals"] == 0 and always["oracle_interventions"] == 1.0 and always["greedy_collisions"] == 0


def test_a_tuning_drives_other_rooms_than_the_evaluation(monkeypatch):
    keys, created = [], trials.environment
    monkeypatch.setattr(trials, "environment", lambda *given: (keys.append(given[2]), created(*given))[1])
    try_threshold(pretrain(GROUND, SailrConfig(**LITTLE)), GROUND, 1.0, 1)
    assert keys == [SEED_KEY, SEED_KEY] and SEED_KEY != FRESH


def test_each_robot_has_values_of_its_own():
    assert max(values_of("secas", GROUND)) <= GROUND.footprint
    for method in ("secas", "sailr"):
        for robot in (GROUND, QUADROTOR):
            assert config_for(method, robot).samples > 1000

"""How a rival's threshold is chosen: by what came of it in closed loop, not by what the model was stored with."""

from dataclasses import replace

from brakeline.deploy.data.rival_pretraining import SailrConfig, config_for, pretrain
from brakeline.deploy.experiments.rival_tuning import ThresholdTrial, best_threshold, tune_threshold, values_of
from brakeline.learner.rival_networks import FitConfig
from tests.robots import GROUND, QUADROTOR

LITTLE = {"samples": 300, "fit": FitConfig(hidden=(8,), epochs=1, batch=32)}


def row(value, oracle, collisions, goals):
    return ThresholdTrial(value, 10, oracle, 0.0, goals, collisions)


def test_safety_counts_among_those_that_cost_the_oracle_nothing():
    rows = [row(1.0, 10, 3, 5), row(2.0, 10, 1, 4), row(3.0, 10, 1, 6), row(4.0, 9, 0, 9)]
    assert best_threshold(rows).value == 3.0
    often = replace(row(0.5, 10, 1, 6), oracle_interventions=0.2)
    assert best_threshold([often, *rows]).value == 3.0, "of two alike, the one that leaves A* alone"
    assert best_threshold([row(1.0, 8, 0, 9), row(2.0, 9, 5, 0)]).value == 2.0, "the least that any value costs"


def test_a_threshold_that_never_steps_in_and_one_that_always_does():
    model = pretrain(GROUND, SailrConfig(**LITTLE))
    reported = []
    never, always = tune_threshold(model, GROUND, (1.0, -1.0), 1, reported.append)
    assert reported == [never, always]
    assert never.oracle_goals == 1 and never.oracle_interventions == 0.0
    assert always.oracle_goals == 0 and always.oracle_interventions == 1.0 and always.greedy_collisions == 0


def test_each_robot_has_values_of_its_own():
    assert max(values_of("secas", GROUND)) <= GROUND.footprint
    for method in ("secas", "sailr"):
        for robot in (GROUND, QUADROTOR):
            assert config_for(method, robot).samples > 1000

"""Test the cost of each source of free space, and flights by range images."""

from collections import Counter
from itertools import islice

import pytest

from benchmarks import perception_cost
from brakeline.deploy.experiments.evaluate import Evaluation, episode, prepare_evaluation
from brakeline.logs.episode_stats import KINDS
from brakeline.sim.sim_conditions import Conditions, Perception, SensorFaults
from tests.accepting import BOUND
from tests.robots import QUADROTOR


def test_a_request_has_kilobytes_with_a_scan_and_hundreds_of_bytes_with_a_map(data_folder, monkeypatch):
    monkeypatch.setattr(perception_cost, "POLICIES", ("random",))
    names = ("map", "scan", "fleet of 2")
    monkeypatch.setattr(perception_cost, "SITUATIONS", {name: perception_cost.SITUATIONS[name] for name in names})
    monkeypatch.setattr(perception_cost, "WARM_UP", 0)
    figures = perception_cost.run(6)
    alone, scan, fleet = (figures[name]["request p50 B"] for name in names)
    assert 300 < alone < fleet < 1000 < 3000 < scan < 5000
    assert all(row["answer p50 ms"] > 0.0 and row["reply p50 B"] > 200 for row in figures.values())


FAULTS = {
    "whole": SensorFaults(),
    "ailing": SensorFaults(dropped=0.1, ghosts=0.01, late=1),
    "blind": SensorFaults(blind=1.0),
}


@pytest.mark.parametrize("faults", FAULTS)
@pytest.mark.parametrize("policy", ["adversary", "greedy"])
def test_a_flight_by_range_images_alone_does_not_collide(flight_folder, policy, faults):
    conditions = Conditions(perception=Perception("scan", FAULTS[faults]))
    what = Evaluation(policy, conditions=conditions, accept_bound=BOUND)
    driver, choose, question = prepare_evaluation(QUADROTOR, what)
    weighed = perception_cost.Weighed(question)
    steps = list(islice(episode(driver, choose, weighed, 0), 40))
    assert len(steps) > 10 and not any(step.collision for step in steps)
    kinds = Counter(KINDS[step.decision] for step in steps)
    assert kinds["adjusted"] > 0, "it was not let at them"
    assert min(weighed.sizes["request"]) > 2 * driver.info["scan"].ranges.size
    if faults == "whole":
        assert kinds["allowed"] + kinds["adjusted"] > 0.5 * len(steps)

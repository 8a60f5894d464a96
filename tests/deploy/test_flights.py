"""Closed loops in flight: in real time each request is about the next period; and flights by range images alone."""

from collections import Counter
from itertools import islice

import numpy as np
import pytest

from benchmarks import perception_cost
from brakeline.actors.episode_runner import ActorIdentity, EpisodeRunner
from brakeline.deploy.data.run_dataset import trajectories_of
from brakeline.deploy.experiments.evaluate import Evaluation, evaluate, prepare_evaluation
from brakeline.logs.episode_stats import KINDS
from brakeline.sim.sim_conditions import Conditions, Perception, SensorFaults
from tests.accepting import BOUND
from tests.deploy.drive import episode
from tests.robots import QUADROTOR

ROBOT = QUADROTOR.in_real_time()
pytestmark = pytest.mark.usefixtures("flight_folder")

FAULTS = {
    "whole": SensorFaults(),
    "ailing": SensorFaults(dropped=0.1, ghosts=0.01, late=1),
    "blind": SensorFaults(blind=1.0),
}


@pytest.mark.parametrize("policy", ["adversary", "greedy", "random"])
def test_no_policy_collides_and_states_stay_in_their_predicted_sets(policy: str) -> None:
    figures = evaluate(ROBOT, Evaluation(policy, episodes=2, accept_bound=BOUND))
    assert figures["collisions"] == 0
    assert figures["containment"]["violations"] <= 0.01 * figures["containment"]["steps"]


def test_a_policy_that_accounts_for_the_delay_reaches_every_goal() -> None:
    figures = evaluate(ROBOT, Evaluation("astar", episodes=3, accept_bound=BOUND))
    assert figures["goals"] == 3 and figures["collisions"] == 0
    assert figures["mean_speed"] > 3.5


def test_without_answers_the_robot_brakes_along_its_backup_plan() -> None:
    driver, policy, ask = prepare_evaluation(ROBOT, Evaluation("greedy", accept_bound=BOUND))
    assert ask is not None
    driver.begin(0)

    def nobody(requests):
        return [None] * len(requests)

    for step in range(14 + ROBOT.horizon):
        proposal = np.asarray(policy(driver.observation, driver.info))
        outcome = driver.decide(proposal, ask if step < 14 else nobody)
        expected = driver.backup_plan.plan[1].copy()
        taken = driver.execute(proposal, outcome)
        if step >= 14:
            assert taken.fallback and taken.action == pytest.approx(expected, abs=1e-6)
            assert driver.info["input_in_force"] == pytest.approx(expected, abs=1e-6)
        assert not taken.collision

    assert np.linalg.norm(driver.info["state"][3:6]) < 0.2


def test_a_continuous_flight_keeps_its_plan_from_goal_to_goal() -> None:
    driver, _, ask = prepare_evaluation(ROBOT, Evaluation("greedy", accept_bound=BOUND))
    assert ask is not None
    flying = EpisodeRunner(ROBOT, driver.env, ActorIdentity("a", 0, 0), continuous=True)
    flying.begin(0)
    outcome = flying.decide(np.array([1.0, 0.0, 0.0]), ask)
    flying.execute(np.array([1.0, 0.0, 0.0]), outcome)
    plan = flying.backup_plan.plan.copy()
    assert plan.any()
    flying.begin(1)
    assert (flying.backup_plan.plan == plan).all()


def test_a_log_has_the_inputs_in_force() -> None:
    driver, policy, ask = prepare_evaluation(ROBOT, Evaluation("greedy", accept_bound=BOUND))
    steps, in_force = [], []
    for step in episode(driver, policy, ask, 0):
        steps.append(step)
        in_force.append(np.array(driver.info["input_in_force"]))  # from the state after this step on
    (trajectory,) = trajectories_of(steps, ROBOT)
    assert trajectory.states == pytest.approx(np.array([step.state for step in steps[1:]]))
    assert trajectory.inputs == pytest.approx(np.array(in_force[1:-1]), abs=1e-6)
    assert trajectory.before == pytest.approx(in_force[0], abs=1e-6)
    assert len(trajectory.paths) == len(trajectory.inputs) == len(trajectory.states) - 1


def test_a_request_has_kilobytes_with_a_scan_and_hundreds_of_bytes_with_a_map(data_folder, monkeypatch):
    monkeypatch.setattr(perception_cost, "POLICIES", ("random",))
    names = ("map", "scan", "fleet of 2")
    monkeypatch.setattr(perception_cost, "SITUATIONS", {name: perception_cost.SITUATIONS[name] for name in names})
    monkeypatch.setattr(perception_cost, "WARM_UP", 0)
    figures = perception_cost.run(6)
    alone, scan, fleet = (figures[name]["request p50 B"] for name in names)
    assert 300 < alone < fleet < 1000 < 3000 < scan < 5000
    assert all(row["answer p50 ms"] > 0.0 and row["reply p50 B"] > 200 for row in figures.values())


@pytest.mark.parametrize("faults", FAULTS)
@pytest.mark.parametrize("policy", ["adversary", "greedy"])
def test_a_flight_by_range_images_alone_does_not_collide(policy, faults):
    conditions = Conditions(perception=Perception("scan", FAULTS[faults]))
    what = Evaluation(policy, conditions=conditions, accept_bound=BOUND)
    driver, choose, ask = prepare_evaluation(QUADROTOR, what)
    weighed = perception_cost.Weighed(ask)
    steps = list(islice(episode(driver, choose, weighed, 0), 40))
    assert len(steps) > 10 and not any(step.collision for step in steps)
    kinds = Counter(KINDS[step.decision] for step in steps)
    assert kinds["adjusted"] > 0, "it was not let at them"
    assert min(weighed.sizes["request"]) > 2 * driver.info["scan"].ranges.size
    if faults == "whole":
        assert kinds["allowed"] + kinds["adjusted"] > 0.5 * len(steps)

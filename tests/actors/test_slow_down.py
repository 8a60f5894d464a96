"""When a robot slows down because more plans leave their tubes than stated, and when that ends."""

import logging
from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import binom

from brakeline.actors.episode_runner import RobotGroup, run_episode
from brakeline.actors.slow_down import SLOW, SlowDown, probability_of_at_least
from brakeline.deploy.data.certification import certify
from brakeline.deploy.data.simulated_recording import data_for
from brakeline.deploy.experiments.evaluate import Evaluation, in_process, prepare_evaluation
from brakeline.deploy.experiments.trials import take_step
from brakeline.safety.filter.filter import Filter
from brakeline.safety.filter.widening import PLANS, Widening
from brakeline.safety.model.model_set import ONE_STEP, ModelConfig
from brakeline.safety.service.in_process import InProcess
from tests.robots import GROUND, QUADROTOR
from tests.safety.test_one_step import certified
from tests.safety.test_turning_in_place import wandering
from tests.safety.unicycle import Unicycle

BOUND = 0.01


@pytest.mark.parametrize(
    ("outside", "plans", "bound"), [(1, 200, 0.0002), (7, 200, 0.01), (200, 200, 0.5), (3, 40, 1.0)]
)
def test_the_probability_of_so_many_plans_outside_is_the_binomial_tail(outside, plans, bound):
    assert probability_of_at_least(outside, plans, bound) == pytest.approx(
        binom.sf(outside - 1, plans, bound), abs=1e-12
    )


def test_the_limit_begins_with_confidence_and_ends_when_the_share_is_back(caplog):
    slow = SlowDown(GROUND, "actor-0")
    with caplog.at_level(logging.WARNING, "brakeline.actor"):
        for outside, active in ((0, False), (3, False), (5, False), (9, True), (5, True), (3, True), (2, False)):
            slow.update([True] * outside + [False] * (PLANS - outside), BOUND)
            assert slow.active is active, outside
    begun, ended = (record.getMessage() for record in caplog.records)
    assert "slowing down to 50 %" in begun and "9 of the last 200 plans left their tubes, stated: at most 1 %" in begun
    assert "no longer slowed down: 2 of the last 200" in ended


def test_a_new_model_set_ends_the_limit_and_one_that_states_nothing_begins_none():
    slow = SlowDown(GROUND, "actor-0")
    slow.update([True] * PLANS, None)
    assert not slow.active
    slow.update([True] * PLANS, BOUND)
    assert slow.active
    slow.update([], BOUND)
    assert not slow.active


@pytest.mark.parametrize("robot", [GROUND, QUADROTOR], ids=lambda robot: robot.name)
def test_a_limited_proposal_keeps_its_direction(robot):
    slow, rng, high = SlowDown(robot, "actor-0"), np.random.default_rng(0), np.asarray(robot.high())
    fast = rng.uniform(robot.low(), robot.high(), (100, robot.action_dim))
    assert all((slow.proposal(u) == u).all() for u in fast)
    slow.update([True] * PLANS, BOUND)
    assert slow.share == SLOW
    moves = np.array(robot.translates)
    for u in fast:
        limited = slow.proposal(u)
        assert (np.abs(limited[moves]) <= SLOW * high[moves] + 1e-12).all()
        assert (limited[~moves] == u[~moves]).all()
        assert np.linalg.norm(u[moves]) * limited[moves] == pytest.approx(np.linalg.norm(limited[moves]) * u[moves])
        assert slow.proposal(limited) == pytest.approx(limited)
    odd = np.full(robot.action_dim, np.nan)
    assert np.isnan(slow.proposal(odd)).all()


def test_plans_are_counted_one_after_the_other_against_the_sets_as_they_were_asked_for():
    widening, N = Widening(QUADROTOR), QUADROTOR.horizon
    still = np.zeros(QUADROTOR.state_dim), np.zeros(3), np.zeros(3)
    scores = iter([*[2.0] * 5 * N])
    for _ in range(5 * N):
        if widening.past is not None:
            widening.judge(next(scores))
        widening.executed(*still)
    assert list(widening.left) == [True, True, False, False], "the second was asked for before the first was judged"
    widening.interrupt()
    for _ in range(N):
        widening.executed(*still)
    widening.judge(1e6)
    assert len(widening.left) == 5 and widening.left[-1]
    widening.forget()
    assert not widening.left


def test_a_robot_that_changes_drives_slower_until_its_sets_hold_again():
    """For a while the robot slips more and more, faster than the widening follows; before and after, its sets hold."""
    model = certified()[0]
    client = InProcess(Filter(replace(model, about=model.about | {"bound_plan": "0.0002"})), accept_bound=1.0)
    rng = np.random.default_rng(5)
    robot, slow, active = Unicycle((0.0, 0.0, 0.0), rng), SlowDown(client.robot, "actor-0"), []
    for period, proposal in enumerate(wandering(rng, 2600)):
        robot.slip = -min(0.002 * 1.05 ** (period - 900), 0.6) * (900 <= period < 1200)
        limited = slow.proposal(proposal)
        answer = client.decide(robot.measure(), limited, [], known_free=True)
        slow.update(client.backup_plan.widening.left, answer.bound)
        robot.step(answer.action)
        active.append(slow.active)
        assert not active[-1] or np.abs(slow.proposal(proposal)[0]) <= SLOW * client.robot.high()[0] + 1e-9
    began = active.index(True)
    assert 900 <= began < 1000
    assert True not in active[:900] and not active[-1]
    assert active[began:].index(False) >= PLANS, "until the plans that left are no longer among the last ones"


@pytest.mark.parametrize("loop", ["run_episode", "take_step"])
def test_every_loop_limits_the_proposals_of_a_slow_robot_before_it_asks(loop):
    runner, _, _ = prepare_evaluation(GROUND, Evaluation("random", "none"))
    runner.slow_down.update([True] * PLANS, BOUND)
    fast = lambda observation, info: np.asarray(GROUND.high())  # noqa: E731
    if loop == "take_step":
        runner.begin(0)
        step = take_step(runner, fast, None)
    else:
        (step,) = next(run_episode(RobotGroup([runner]), [fast], None, 0))
    assert list(step.proposed) == pytest.approx([SLOW * GROUND.high()[0], GROUND.high()[1]])


def driving(policy, steps, seed, payload=()):
    """Yield whether the ground robot is slowed down. payload: periods between which it carries 2 kg."""
    model = certify(data_for(GROUND), ModelConfig(mode=ONE_STEP))[0]
    runner, policy, _ = prepare_evaluation(GROUND, Evaluation(policy, "none", seed=seed))
    ask, period, episode = in_process(model, 1.0), 0, 0
    while period < steps:
        for _ in run_episode(RobotGroup([runner]), [policy], ask, episode):
            if period in payload:
                runner.env.alter(payload_kg=2.0 if period == payload[0] else 0.0)
            period += 1
            yield runner.slow_down.active
        episode += 1


@pytest.mark.long
def test_a_payload_that_the_widening_follows_does_not_slow_the_ground_robot_down(data_folder):
    """Two of 200 plans leave their sets as they are widened: too few to be sure that the widening fails."""
    assert not any(driving("random", 6000, 3, payload=(1000, 3000)))


@pytest.mark.long
@pytest.mark.parametrize("policy", ["random", "trained", "adversary"])
def test_a_right_model_never_slows_the_ground_robot_down(data_folder, policy):
    assert not any(driving(policy, 22_000, 5))

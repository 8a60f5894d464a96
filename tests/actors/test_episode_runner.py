"""One robot in its episodes, without a bus; with SAILR's training, an intervention ends the episode for the learner.
Where not even hovering can be verified, a vehicle stays on the ground, and gets out of there in the air.
"""

import numpy as np
import pytest

from brakeline.actors.decision_guard import request_decisions
from brakeline.actors.episode_runner import ActorIdentity, EpisodeRunner
from brakeline.actors.flight_process import takeoff_verified
from brakeline.deploy.data.model_store import model_for
from brakeline.deploy.experiments.evaluate import in_process
from brakeline.deploy.vehicle_factory import environment
from brakeline.errors import TakeoffNotVerified
from brakeline.learner.transition_reader import StepReader
from brakeline.logs.episode_stats import EpisodeStats
from brakeline.messaging import brakeline_pb2 as pb
from brakeline.messaging.obstacle import Obstacle
from brakeline.safety.filter.request import NOT_FINITE
from brakeline.safety.model.model_config import ModelConfig
from brakeline.safety.service.wire import KIND_NUMBERS
from brakeline.sim.arena import Arena
from brakeline.sim.delayed_vehicle import delayed
from brakeline.sim.navigation_env import NavigationEnv
from brakeline.sim.quadrotor import Quadrotor
from tests.accepting import BOUND
from tests.actors.conftest import no_answer
from tests.arenas import staged_arena
from tests.robots import GROUND, QUADROTOR
from tests.safety.rivals.test_sailr import known

SLOW, FAST = np.array([0.05, 0.1]), np.array([0.25, 0.1])


def make_runner(number: int = 0, seed: int = 0, **more) -> EpisodeRunner:
    return EpisodeRunner(GROUND, environment(GROUND, "default", seed), ActorIdentity("actor-0", number, seed), **more)


def make_cutting_runner() -> EpisodeRunner:
    """Return a runner in its first episode, which an intervention ends."""
    runner = make_runner(penalty=5.0, ends_on_intervention=True)
    runner.begin(0)
    return runner


def step(runner: EpisodeRunner, proposal, ask) -> pb.Step:
    return runner.execute(proposal, runner.decide(proposal, ask))


def test_a_step_records_the_proposal_the_decision_and_the_result(ask):
    robot = make_runner(penalty=2.0)
    episode = robot.begin(5)
    assert (episode.episode, episode.actor, episode.arena) == (5, "actor-0", "default")
    assert episode.obstacles and len(episode.start) == 5 and episode.goal_radius > 0
    observation = robot.observation
    for number in range(40):
        outcome = robot.decide(FAST, ask)
        step = robot.execute(FAST, outcome, weights_version=3)
        assert (step.episode, step.step, step.index, step.weights_version) == (5, number, number + 1, 3)
        assert np.array_equal(np.float32(step.observation), observation)
        assert np.array_equal(np.float32(step.next_observation), robot.observation)
        assert step.decision == KIND_NUMBERS[outcome.answer.kind] and step.decide_ms > 0 and not step.fallback
        assert np.allclose(step.action, outcome.answer.action) and np.allclose(step.proposed, FAST)
        intervened = step.decision != pb.ALLOWED
        assert (step.penalty > 0) == intervened and step.penalty <= 2.0 * np.sqrt(2)
        assert step.compared and step.contained
        assert len(step.state) == len(step.true_state) == 5 and len(step.path) % 2 == 0 and step.path
        assert not step.collision and step.clearance > 0 and step.header.time == pytest.approx(0.2 * (number + 1))
        observation = robot.observation
        if not robot.running:
            break


def test_the_state_after_a_step_is_compared_with_the_prediction_unless_there_was_no_answer(ask):
    robot = make_runner()
    robot.begin(0)
    for falsified in (False, True):
        outcome = robot.decide(FAST, ask)
        if falsified:  # a prediction that cannot come true
            outcome.answer.predicted.center[0] += 1.0
        compared = robot.execute(FAST, outcome)
        assert compared.compared and compared.contained is not falsified
    plan = robot.backup_plan.plan.copy()
    fallback = step(robot, FAST, no_answer)
    assert fallback.fallback and fallback.decision == pb.FAILSAFE and not fallback.compared
    assert np.allclose(fallback.action, plan[0])


@pytest.mark.parametrize(("proposal", "action"), [([9.0, -9.0], [0.25, -0.5]), ([np.nan, 0.3], [0.0, 0.0])])
def test_without_a_filter_the_proposal_is_clipped_to_bounds_and_nan_becomes_zero(proposal, action):
    robot = make_runner(filtered=False)
    robot.begin(0)
    step_taken = robot.execute(np.array(proposal), None)
    assert np.allclose(step_taken.action, action)
    assert (step_taken.decision, step_taken.penalty, step_taken.compared) == (pb.UNKNOWN, 0.0, False)


@pytest.mark.parametrize("proposal", [[np.nan, 0.1], [np.inf, 0.0]])
def test_a_proposal_of_nan_is_a_failsafe_and_a_step_that_the_learner_accepts(ask, proposal):
    robot = make_runner(penalty=2.0)
    robot.begin(0)
    step(robot, FAST, ask)
    outcome = robot.decide(np.array(proposal), ask)
    assert np.array_equal(outcome.exchange(0.2).request.action, proposal, equal_nan=True)
    assert (outcome.answer.kind, outcome.answer.reason) == ("failsafe", NOT_FINITE)
    failsafe = robot.execute(np.array(proposal), outcome)
    assert failsafe.decision == pb.FAILSAFE and failsafe.proposed == failsafe.action == [0.0, 0.0]
    StepReader(GROUND).move(failsafe)


def test_all_robots_of_a_run_have_different_episodes():
    seeds = {
        ActorIdentity(f"actor-{number}", number, 0).episode_seed(episode)
        for number in range(64)
        for episode in range(200)
    }
    assert len(seeds) == 64 * 200
    arenas = {
        make_runner(number, seed).begin(episode).SerializeToString()
        for number in (0, 1)
        for seed in (0, 1)
        for episode in (0, 1)
    }
    assert len(arenas) == 8
    one, same = make_runner(1, 7), make_runner(1, 7)
    assert one.begin(3) == same.begin(3)
    assert one.rng.random() == same.rng.random()
    same.begin(4)
    assert one.rng.random() != same.rng.random()


def test_a_step_has_the_number_of_its_request_even_if_periods_are_skipped(ask, monkeypatch):
    robot = make_runner()
    robot.begin(0)
    drive = robot.env.step

    def skip_a_period(action):  # as a flight that observes too late
        robot.skip()
        return drive(action)

    for number in (0, 1, 3):
        request = robot.request(FAST)
        monkeypatch.setattr(robot.env, "step", skip_a_period if number == 1 else drive)
        assert robot.execute(FAST, request_decisions(ask, [request], GROUND)[0]).step == request.step == number


def test_an_intervention_is_a_terminal_step_for_the_learner_alone():
    runner = make_cutting_runner()
    ask = in_process(known(threshold=0.3))
    allowed, cut = (step(runner, proposal, ask) for proposal in (SLOW, FAST))
    assert not allowed.cut and allowed.penalty == 0.0 and allowed.decision == pb.ALLOWED
    assert cut.cut and cut.decision == pb.FAILSAFE and not any(cut.action) and list(cut.proposed) == pytest.approx(FAST)
    assert cut.reward - cut.penalty == pytest.approx(GROUND.task.reward.cut) and cut.reward > -5
    assert not cut.terminated and not cut.goal and not cut.collision, "the environment's episode has not ended"
    assert cut.truncated and not runner.running, "the robot's episode has ended"
    stats = EpisodeStats()
    for step_taken in (allowed, cut):
        stats.step(step_taken)
    assert (stats.timeouts, stats.collisions, stats.goals, len(stats.returns)) == (0, 0, 0, 1)


def test_outside_of_training_an_intervention_does_not_end_the_episode():
    runner = make_runner()
    runner.begin(0)
    ask = in_process(known(threshold=0.3))
    for number, proposal in enumerate((FAST, FAST, SLOW)):
        step_taken = step(runner, proposal, ask)
        assert runner.running and not step_taken.cut and step_taken.step == number
        assert (step_taken.decision == pb.FAILSAFE) == (proposal is FAST)


def test_a_collision_while_braking_keeps_its_reward():
    runner = make_cutting_runner()
    step_taken = pb.Step(reward=-100.0, terminated=True, collision=True, decision=pb.FAILSAFE)
    runner.running = False
    runner._end_on_intervention(step_taken)
    assert step_taken.cut and step_taken.penalty == 0.0 and step_taken.terminated and not step_taken.truncated


def test_a_missing_answer_is_not_an_intervention():
    runner = make_cutting_runner()
    step(runner, SLOW, in_process(known(threshold=0.3)))
    fallback = step(runner, SLOW, no_answer)
    assert fallback.fallback and not fallback.cut and fallback.penalty >= 0.0


def stage(gap: float) -> Arena:
    """Return an arena with a sphere whose distance from the body is `gap` [m] at the start."""
    radius = 0.4
    away = QUADROTOR.footprint + gap + radius
    return staged_arena(
        Obstacle("sphere", (away, 0.0, 3.0), (radius,)),
        start=(0.0, 0.0, 3.0),
        goal=(-4.0, -4.0, 3.0),
        half_width=6.0,
        height=6.0,
    )


@pytest.mark.usefixtures("flight_folder")
def test_no_takeoff_where_hovering_cannot_be_verified() -> None:
    robot = QUADROTOR.in_real_time()
    question = in_process(model_for(robot, ModelConfig(), BOUND), BOUND)
    assert takeoff_verified(question, robot, stage(2.0), True, lambda: False)
    with pytest.raises(TakeoffNotVerified, match=r"0\.\d+ m from the nearest obstacle.*collect more data"):
        takeoff_verified(question, robot, stage(0.02), True, lambda: False)
    assert takeoff_verified(question, robot, stage(0.02), False, lambda: False), "a rival method cannot verify hovering"


@pytest.mark.usefixtures("flight_folder")
def test_in_real_time_recovery_continues_period_after_period() -> None:
    """A recovery in every other period would not move a real vehicle: it does not follow so short a command."""
    robot = QUADROTOR.in_real_time()
    question = in_process(model_for(robot, ModelConfig(), BOUND), BOUND)
    make = delayed(Quadrotor, robot)
    env = NavigationEnv(
        robot, "default", make, draw=lambda *_: staged_arena(start=(0.0, 0.0, 3.0), goal=(-4.0, -4.0, 3.0), height=6.0)
    )
    runner = EpisodeRunner(robot, env, ActorIdentity("actor", 0, 0))
    runner.begin(0)
    kinds = []
    for _ in range(25):
        runner.info["obstacles"] = (Obstacle("sphere", (0.5, 0.0, 3.0), (0.6,)),)  # a virtual one around the vehicle
        outcome = runner.decide(np.zeros(3), question)
        assert outcome is not None and outcome.answer is not None
        kinds.append(outcome.answer.kind)
        runner.execute(np.zeros(3), outcome)
    on_the_way = kinds[: len(kinds) - kinds[::-1].index("recovering")]
    assert set(on_the_way) == {"recovering"} and len(on_the_way) >= 2 and kinds[-1] == "allowed", kinds

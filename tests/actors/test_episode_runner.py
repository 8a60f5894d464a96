"""One robot in its episodes, without a bus. Without a valid answer it brakes along its committed plan and stands; with
the next answer it drives on. Where not even hovering can be verified, a vehicle stays on the ground.
"""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from brakeline.actors.decision_guard import Ask, at_rest, next_input, request_decisions
from brakeline.actors.episode_runner import ActorIdentity, EpisodeRunner
from brakeline.actors.flight_process import takeoff_verified
from brakeline.deploy.data.model_store import model_for
from brakeline.deploy.experiments.evaluate import in_process
from brakeline.deploy.vehicle_factory import environment
from brakeline.errors import BusError, Late, NoReply, Refused, TakeoffNotVerified
from brakeline.learner.transition_reader import StepReader
from brakeline.logs.episode_stats import EpisodeStats
from brakeline.messaging import brakeline_pb2 as pb
from brakeline.messaging.obstacle import Obstacle
from brakeline.safety.filter.backup_plan import BackupPlan
from brakeline.safety.filter.request import NOT_FINITE
from brakeline.safety.model.model_config import ModelConfig
from brakeline.safety.service.client import request_message
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

PLAN = np.array([[0.2, 0.3], [0.1, 0.15], [0.0, 0.0]])
REQUEST = pb.Request(robot="ground", input_in_force=[0.0, 0.0])
IN_REAL_TIME = QUADROTOR.in_real_time()


def decision(plan=PLAN, **fields):
    values = {"kind": pb.ALLOWED, "plan": np.ravel(plan), "model": "abc", "verified": True, "bound": 0.01}
    values |= {"tube_center": [0.0] * 6, "tube_half_width": [0.1] * 6}
    predicted = {"predicted_center": [0.0] * 5, "predicted_half_width": [1.0] * 5}
    return pb.Reply(robot="ground", decision=pb.Decision(**(values | predicted | fields)))


def outcome_of(reply):
    """Return the outcome of a question whose answer is `reply`, or which fails with it."""

    def ask(requests):
        if isinstance(reply, BusError):
            raise reply
        return [reply] * len(requests)

    return request_decisions(ask, [REQUEST], GROUND)[0]


def committed():
    """Return the backup plan of a robot that executes the first input of PLAN."""
    backup_plan = BackupPlan(GROUND)
    assert (next_input(backup_plan, outcome_of(decision())) == PLAN[0]).all()
    return backup_plan


FAILURES = {
    "late": Late("no answer within 100 ms"),
    "nobody": NoReply("nobody answers"),
    "refused": Refused(pb.Error(type="BadRequest", field="payload", message="not a request batch")),
    "error": pb.Reply(error=pb.Error(type="StaleModel", field="model", message="never in use here")),
    "empty": pb.Reply(),
    "backwards": decision(-PLAN),
    "no stop at its end": decision(np.ones((3, 2)) * 0.1),
}  # `test_malformed_replies.py` has the other malformed replies


@pytest.mark.parametrize("failure", FAILURES.values(), ids=FAILURES.keys())
def test_without_a_decision_the_robot_follows_its_plan_to_the_end_and_stands(failure):
    backup_plan, executed = committed(), []
    for _ in range(5):
        outcome = outcome_of(failure)
        assert outcome.answer is None and outcome.failure
        executed.append(next_input(backup_plan, outcome))
    assert np.array(executed).tolist() == [[0.1, 0.15], [0, 0], [0, 0], [0, 0], [0, 0]]
    assert backup_plan.predicted is None, "no prediction holds any more"


def test_the_exchange_contains_the_failure_and_the_reply():
    assert outcome_of(FAILURES["late"]).exchange(1.0).failure.startswith("Late: no answer within 100 ms")
    refused = outcome_of(FAILURES["error"]).exchange(1.0)
    assert refused.failure == "StaleModel: never in use here"
    assert refused.reply.error.field == "model"
    allowed = outcome_of(decision()).exchange(2.5)
    assert (allowed.failure, allowed.header.time, allowed.reply.decision.model) == ("", 2.5, "abc")
    assert allowed.round_trip_ms > 0.0


def test_a_robot_is_at_rest_only_if_its_input_and_its_plan_are_zero():
    backup_plan = BackupPlan(GROUND)
    assert at_rest(backup_plan)
    next_input(backup_plan, outcome_of(decision()))
    moving = []
    for _ in range(3):
        moving.append(at_rest(backup_plan))
        next_input(backup_plan, outcome_of(FAILURES["nobody"]))
    assert moving == [False, False, True], "it still moves while the last but one input, the first zero, is executed"
    backup_plan = BackupPlan(GROUND)
    next_input(backup_plan, outcome_of(decision(np.array([[0.0, 0.0], [0.1, 0.0], [0.0, 0.0]]))))
    assert not at_rest(backup_plan), "it stands, but has committed to move"


def test_the_robot_drives_on_when_the_service_answers_again():
    backup_plan = committed()
    next_input(backup_plan, outcome_of(FAILURES["late"]))
    again = np.array([[0.25, -0.5], [0.0, 0.0], [0.0, 0.0]])
    assert (next_input(backup_plan, outcome_of(decision(again))) == again[0]).all()
    assert backup_plan.model == "abc" and backup_plan.predicted is not None
    for _ in range(3):
        next_input(backup_plan, outcome_of(FAILURES["late"]))
    request = request_message(backup_plan, np.zeros(5), np.zeros(2), known_free=True)
    assert request.model == "" and not any(request.plan), "standing still needs no verification"


def test_an_invalid_reply_about_one_robot_does_not_affect_the_others():
    replies = [decision(), FAILURES["error"], decision()]
    outcomes = request_decisions(lambda requests: replies, [REQUEST] * 3, GROUND)
    assert [outcome.answer is not None for outcome in outcomes] == [True, False, True]
    lost = request_decisions(no_answer, [REQUEST] * 3, GROUND)
    assert [outcome.failure for outcome in lost] == ["NoReply: gone"] * 3


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


@pytest.mark.parametrize("number", [0, 5])
@pytest.mark.parametrize("episode", [0, 1, 7])
def test_exploration_has_another_stream_than_the_arena_of_any_episode(number, episode):
    """NumPy ignores zeros at the end of a key: the noise of each robot's first episode had the stream of its arena."""
    identity = ActorIdentity("actor-0", number, 3)
    arenas = {np.random.default_rng((3, identity.episode_seed(e))).random() for e in range(20)}
    assert identity.exploration(episode).random() not in arenas


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


def hall(*obstacles: Obstacle) -> Arena:
    return staged_arena(*obstacles, start=(0.0, 0.0, 3.0), goal=(-4.0, -4.0, 3.0), half_width=6.0, height=6.0)


def beside(gap: float) -> Arena:
    """Return an arena with a sphere whose distance from the body is `gap` [m] at the start."""
    return hall(Obstacle("sphere", (IN_REAL_TIME.footprint + gap + 0.4, 0.0, 3.0), (0.4,)))


@pytest.fixture
def flight_filter(flight_folder: Path) -> Ask:
    return in_process(model_for(IN_REAL_TIME, ModelConfig(), BOUND), BOUND)


def test_no_takeoff_where_hovering_cannot_be_verified(flight_filter: Ask) -> None:
    assert takeoff_verified(flight_filter, IN_REAL_TIME, beside(2.0), True, lambda: False)
    with pytest.raises(TakeoffNotVerified, match=r"0\.\d+ m from the nearest obstacle.*collect more data"):
        takeoff_verified(flight_filter, IN_REAL_TIME, beside(0.02), True, lambda: False)

    def braking(requests: Sequence[pb.Request]) -> list[pb.Reply]:
        replies = flight_filter(requests)
        for reply in replies:
            reply.decision.kind, reply.decision.reason = pb.FAILSAFE, "no plan"
        return replies

    nothing_near = replace(hall(), obstacles=())
    with pytest.raises(TakeoffNotVerified, match=r"hovering at the start can't be verified \(no plan\)"):
        takeoff_verified(braking, IN_REAL_TIME, nothing_near, True, lambda: False)
    assert takeoff_verified(flight_filter, IN_REAL_TIME, beside(0.02), False, lambda: False), (
        "a rival cannot verify hovering"
    )


def test_in_real_time_recovery_continues_period_after_period(flight_filter: Ask) -> None:
    """A recovery in every other period would not move a real vehicle: it does not follow so short a command."""
    env = NavigationEnv(IN_REAL_TIME, make_vehicle=delayed(Quadrotor, IN_REAL_TIME), draw=lambda *_: hall())
    runner = EpisodeRunner(IN_REAL_TIME, env, ActorIdentity("actor", 0, 0))
    runner.begin(0)
    kinds = []
    for _ in range(25):
        runner.info["obstacles"] = (Obstacle("sphere", (0.5, 0.0, 3.0), (0.6,)),)  # a virtual one around the vehicle
        outcome = runner.decide(np.zeros(3), flight_filter)
        assert outcome is not None and outcome.answer is not None
        kinds.append(outcome.answer.kind)
        runner.execute(np.zeros(3), outcome)
    on_the_way = kinds[: len(kinds) - kinds[::-1].index("recovering")]
    assert set(on_the_way) == {"recovering"} and len(on_the_way) >= 2 and kinds[-1] == "allowed", kinds

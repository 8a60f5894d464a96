"""SAILR's training: an intervention is a terminal step for the learner only."""

import numpy as np
import pytest

from brakeline.actors.episode_runner import ActorIdentity, EpisodeRunner
from brakeline.deploy.experiments.evaluate import in_process
from brakeline.deploy.vehicle_factory import environment
from brakeline.errors import NoReply
from brakeline.logs.episode_stats import EpisodeStats
from brakeline.messaging import brakeline_pb2 as pb
from tests.robots import GROUND
from tests.safety.rivals.test_sailr import known

SLOW, FAST = np.array([0.05, 0.1]), np.array([0.25, 0.1])


@pytest.fixture
def runner() -> EpisodeRunner:
    env, identity = environment(GROUND, "default", 0), ActorIdentity("a", 0, 0)
    runner = EpisodeRunner(GROUND, env, identity, penalty=5.0, ends_on_intervention=True)
    runner.begin(0)
    return runner


def step(runner: EpisodeRunner, proposal, ask) -> pb.Step:
    return runner.execute(proposal, runner.decide(proposal, ask))


def test_an_intervention_is_a_terminal_step_for_the_learner_alone(runner):
    ask = in_process(known(threshold=0.3))
    allowed, cut = (step(runner, proposal, ask) for proposal in (SLOW, FAST))
    assert not allowed.cut and allowed.penalty == 0.0 and allowed.decision == pb.ALLOWED
    assert cut.cut and cut.decision == pb.FAILSAFE and not any(cut.action) and list(cut.proposed) == pytest.approx(FAST)
    assert cut.reward - cut.penalty == pytest.approx(GROUND.task.reward.cut) and cut.reward > -5
    assert not cut.terminated and not cut.goal and not cut.collision, "nothing ended in the environment"
    assert cut.truncated and not runner.running, "the robot's episode was called off"
    stats = EpisodeStats()
    for step_taken in (allowed, cut):
        stats.step(step_taken)
    assert (stats.timeouts, stats.collisions, stats.goals, len(stats.returns)) == (0, 0, 0, 1)


def test_outside_of_training_an_intervention_does_not_end_the_episode():
    runner = EpisodeRunner(GROUND, environment(GROUND, "default", 0), ActorIdentity("a", 0, 0))
    runner.begin(0)
    ask = in_process(known(threshold=0.3))
    for number, proposal in enumerate((FAST, FAST, SLOW)):
        step_taken = step(runner, proposal, ask)
        assert runner.running and not step_taken.cut and step_taken.step == number
        assert (step_taken.decision == pb.FAILSAFE) == (proposal is FAST)


def test_a_collision_while_braking_keeps_its_reward(runner):
    step_taken = pb.Step(reward=-100.0, terminated=True, collision=True, decision=pb.FAILSAFE)
    runner.running = False
    runner._end_on_intervention(step_taken)
    assert step_taken.cut and step_taken.penalty == 0.0 and step_taken.terminated and not step_taken.truncated


def test_a_missing_answer_is_not_an_intervention(runner):
    step(runner, SLOW, in_process(known(threshold=0.3)))
    lost = runner.decide(SLOW, lambda requests: (_ for _ in ()).throw(NoReply("gone")))
    fallback = runner.execute(SLOW, lost)
    assert fallback.fallback and not fallback.cut and fallback.penalty >= 0.0

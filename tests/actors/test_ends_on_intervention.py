"""SAILR's driver: in training an intervention is a terminal step for the learner, and for nobody else."""

import numpy as np
import pytest

from brakeline.actors.episode_runner import ActorIdentity, EpisodeRunner
from brakeline.deploy.experiments.evaluate import in_process
from brakeline.deploy.vehicle_factory import environment
from brakeline.logs.episode_stats import EpisodeStats
from brakeline.messaging import brakeline_pb2 as pb
from brakeline.messaging.bus import NoReply
from tests.robots import GROUND
from tests.safety.rivals.test_sailr import known

SLOW, FAST = np.array([0.05, 0.1]), np.array([0.25, 0.1])


@pytest.fixture
def driver() -> EpisodeRunner:
    env, identity = environment(GROUND, "default", 0), ActorIdentity("a", 0, 0)
    runner = EpisodeRunner(GROUND, env, identity, penalty=5.0, ends_on_intervention=True)
    runner.begin(0)
    return runner


def step(driver: EpisodeRunner, proposal, ask) -> pb.Step:
    return driver.execute(proposal, driver.decide(proposal, ask))


def test_an_intervention_is_a_terminal_step_for_the_learner_alone(driver):
    ask = in_process(known(threshold=0.3))
    allowed, cut = (step(driver, proposal, ask) for proposal in (SLOW, FAST))
    assert not allowed.cut and allowed.penalty == 0.0 and allowed.decision == pb.ALLOWED
    assert cut.cut and cut.decision == pb.FAILSAFE and not any(cut.action) and list(cut.proposed) == pytest.approx(FAST)
    assert cut.reward - cut.penalty == pytest.approx(GROUND.task.reward.cut) and cut.reward > -5
    assert not cut.terminated and not cut.goal and not cut.collision, "nothing ended in the environment"
    assert cut.truncated and not driver.running, "the robot's episode was called off"
    seen = EpisodeStats()
    for taken in (allowed, cut):
        seen.step(taken)
    assert (seen.timeouts, seen.collisions, seen.goals, len(seen.returns)) == (0, 0, 0, 1)


def test_in_use_the_episode_goes_on_behind_the_rule():
    driver = EpisodeRunner(GROUND, environment(GROUND, "default", 0), ActorIdentity("a", 0, 0))
    driver.begin(0)
    ask = in_process(known(threshold=0.3))
    for number, proposal in enumerate((FAST, FAST, SLOW)):
        taken = step(driver, proposal, ask)
        assert driver.running and not taken.cut and taken.step == number
        assert (taken.decision == pb.FAILSAFE) == (proposal is FAST)


def test_a_collision_while_braking_is_still_paid_for_as_one(driver):
    taken = pb.Step(reward=-100.0, terminated=True, collision=True, decision=pb.FAILSAFE)
    driver.running = False
    driver._end_on_intervention(taken)
    assert taken.cut and taken.penalty == 0.0 and taken.terminated and not taken.truncated


def test_a_missing_answer_is_no_intervention(driver):
    step(driver, SLOW, in_process(known(threshold=0.3)))
    lost = driver.decide(SLOW, lambda requests: (_ for _ in ()).throw(NoReply("gone")))
    fallen = driver.execute(SLOW, lost)
    assert fallen.fallback and not fallen.cut and fallen.penalty >= 0.0

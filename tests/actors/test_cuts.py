"""SAILR's driver: an intervention is the learner's end of the episode, not the robot's."""

import numpy as np
import pytest

from actors.driver import LOWEST, Driver, Identity
from actors.guard import consult
from deploy.evaluate import in_process
from deploy.vehicles import environment
from messaging import brakeline_pb2 as pb
from messaging.bus import NoReply
from messaging.robots import GROUND
from tests.safety.test_sailr import known

SLOW, FAST = np.array([0.05, 0.1]), np.array([0.25, 0.1])


@pytest.fixture
def driver() -> Driver:
    made = Driver(GROUND, environment(GROUND, "default", 0), Identity("a", 0, 0), penalty=5.0, cuts=True)
    made.begin(0)
    return made


def step(driver: Driver, proposal, ask) -> pb.Step:
    return driver.execute(proposal, consult(ask, [driver.request(proposal)], GROUND)[0])


def test_the_learner_is_told_of_an_end_with_the_lowest_reward_and_the_robot_drives_on(driver):
    ask = in_process(known(threshold=0.3))
    allowed, cut, after = (step(driver, proposal, ask) for proposal in (SLOW, FAST, SLOW))
    assert not allowed.cut and allowed.penalty == 0.0 and allowed.decision == pb.ALLOWED
    assert cut.cut and cut.decision == pb.FAILSAFE and not any(cut.action) and list(cut.proposed) == pytest.approx(FAST)
    assert cut.reward - cut.penalty == pytest.approx(LOWEST) and cut.reward > -50
    assert not cut.terminated and not cut.truncated and driver.running
    assert (after.episode, after.step, after.cut) == (cut.episode, cut.step + 1, False)


def test_a_missing_answer_is_no_intervention(driver):
    step(driver, SLOW, in_process(known(threshold=0.3)))
    lost = consult(lambda requests: (_ for _ in ()).throw(NoReply("gone")), [driver.request(SLOW)], GROUND)[0]
    fallen = driver.execute(SLOW, lost)
    assert fallen.fallback and not fallen.cut and fallen.penalty >= 0.0

"""The multiplier on the cost of collisions: when it rises, and that a resumed run keeps it."""

from dataclasses import replace

import pytest

from brakeline.learner.checkpoint_state import PartState
from brakeline.learner.lagrange import LagrangeMultiplier
from brakeline.learner.learner import Learner
from brakeline.learner.n_step import NStepWindows
from tests.learner.test_core import started, step
from tests.learner.test_steps import move
from tests.learner.toy import CONFIG, TOY

LIMITED = replace(CONFIG, td3=replace(CONFIG.td3, cost_limit=0.1, multiplier_rate=4.0))


def test_the_multiplier_rises_with_collisions_and_falls_to_zero_without():
    learner, _ = started(LIMITED)
    values = []
    for index, collided in enumerate((True, False, True, *[False] * 20), start=1):
        learner.insert(step(index, episode=index - 1, step=0, terminated=True, collision=collided))
        values.append(learner._td3.cost_weight)
    assert values[:3] == pytest.approx([3.6, 3.2, 6.8]) and values[-1] == 0.0
    free, _ = started(CONFIG)
    free.insert(step(1, terminated=True, collision=True))
    assert free._td3.cost_weight == 0.0


def test_a_resumed_run_keeps_it(tmp_path):
    learner, _ = started(LIMITED)
    learner.insert(step(1, terminated=True, collision=True))
    learner.save(tmp_path)
    resumed = Learner(TOY, LIMITED)
    resumed.restore(tmp_path)
    assert resumed._td3.cost_weight == learner._td3.cost_weight == pytest.approx(3.6)
    for wrong in ("3.6", float("nan"), -1.0):
        with pytest.raises(ValueError, match="no multiplier"):
            LagrangeMultiplier(0.1, 1.0).restore(PartState({}, {"value": wrong}))


def test_the_cost_of_a_window_is_discounted_like_its_reward():
    windows = NStepWindows(3, 0.9)
    moves = [move(0, 0, 1.0), move(0, 1, 1.0), move(0, 2, 1.0, terminated=True)._replace(collision=True)]
    closed = [transition for each in moves for transition in windows.push("a", each)]
    assert [transition.cost for transition in closed] == pytest.approx([0.81, 0.9, 1.0])

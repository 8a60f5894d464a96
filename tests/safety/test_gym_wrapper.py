"""The wrapper passes safe actions and replaces unsafe ones."""

import gymnasium
import numpy as np
import pytest

from brakeline.messaging.obstacle import Obstacle
from brakeline.safety.filter.request import NOT_FINITE
from brakeline.safety.gym import SafetyWrapper
from tests.robots import GROUND
from tests.safety.unicycle import Unicycle

AHEAD = Obstacle("cylinder", (0.34, 0.0), (0.1,))


class Yard(gymnasium.Env):
    """The kinematic robot before one obstacle. The reward is 1 a step."""

    observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (5,), np.float32)
    action_space = gymnasium.spaces.Box(np.array([0, -0.5], np.float32), np.array([0.25, 0.5], np.float32))

    def __init__(self, obstacle=AHEAD):
        self.obstacle = obstacle
        self.executed = []

    def _now(self):
        state = self.robot.measure()
        return state.astype(np.float32), {"state": state, "obstacles": [self.obstacle]}

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.robot, self.executed = Unicycle((0, 0, 0), np.random.default_rng(seed)), []
        return self._now()

    def step(self, action):
        assert action.dtype == np.float32
        self.executed.append(action)
        self.robot.step(action)
        observation, info = self._now()
        return observation, 1.0, False, False, info


def test_the_wrapper_passes_safe_actions(ready):
    env = SafetyWrapper(Yard(Obstacle("cylinder", (3.0, 0.0), (0.1,))), ready, penalty=2.0, accept_bound=1.0)
    env.reset(seed=0)
    _, reward, _, _, info = env.step(np.array([0.2, 0.25], np.float32))
    assert np.array_equal(env.unwrapped.executed[0], np.array([0.2, 0.25], np.float32))
    assert info["safety"].kind == "allowed"
    assert (reward, info["penalty"]) == (1.0, 0.0)
    assert np.array_equal(info["proposed"], np.array([0.2, 0.25], np.float32))
    _, reward, *_ = env.step(np.array([9.0, 0.0]))
    assert reward == 1.0, "clipping to bounds costs nothing"


def test_the_wrapper_replaces_and_penalises_unsafe_actions(ready):
    env = SafetyWrapper(Yard(), ready, penalty=2.0, accept_bound=1.0)
    env.reset(seed=1)
    kinds, costs = set(), []
    for _ in range(60):
        _, reward, _, _, info = env.step(np.array([0.25, 0.0]))
        kinds.add(info["safety"].kind)
        off = np.linalg.norm((info["safety"].action - [0.25, 0.0]) / [0.25, 1.0])
        assert info["penalty"] == pytest.approx(2.0 * off)
        assert reward == pytest.approx(1.0 - info["penalty"])
        costs.append(info["penalty"])
        assert np.hypot(*(env.unwrapped.robot.state[:2] - [0.34, 0.0])) > 0.1 + GROUND.footprint
    assert "adjusted" in kinds
    assert max(costs) > 1.0


@pytest.mark.parametrize("wrong", [float("nan"), float("inf"), -float("inf")])
def test_a_proposal_that_is_not_finite_is_a_failsafe(ready, wrong):
    env = SafetyWrapper(Yard(), ready, penalty=1.0, accept_bound=1.0)
    env.reset(seed=2)
    _, reward, _, _, info = env.step(np.array([wrong, 0.1]))
    assert not env.unwrapped.executed[0].any()
    assert np.isfinite(reward)
    diagnostics = info["diagnostics"]
    assert (diagnostics["kind"], diagnostics["verified"], diagnostics["reason"]) == ("failsafe", True, NOT_FINITE)


def test_every_episode_starts_standing(ready):
    env = SafetyWrapper(Yard(), ready, accept_bound=1.0)
    env.reset(seed=3)
    env.step(np.array([0.25, 0.1]))
    assert env.backup_plan.input_in_force.any()
    env.reset(seed=4)
    assert not env.backup_plan.input_in_force.any()
    assert env.backup_plan.predicted is None

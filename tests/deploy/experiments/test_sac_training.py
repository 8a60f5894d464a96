"""SAC beside our learner: the same robots and steps, and a policy that the same evaluations drive."""

import numpy as np
import pytest
from stable_baselines3 import SAC

from brakeline.deploy.batch_robots import BatchRobots
from brakeline.deploy.experiments.sac_training import RobotsAsVecEnv, _layers
from brakeline.messaging.policy_weights import MLP
from brakeline.messaging.task import robot_with_task
from brakeline.safety.filter.filter import Filter

GROUND = robot_with_task("ground")


@pytest.fixture
def env():
    robots = BatchRobots(GROUND, ["a", "b"], Filter.load("ground"), lambda number: (0, number), penalty=1.0)
    taken = []
    env = RobotsAsVecEnv(GROUND, robots, 0.1, taken.append, taken.append)
    env.taken = taken
    yield env
    env.close()


def test_the_policy_is_the_deterministic_one_of_sac(env):
    model = SAC("MlpPolicy", env, policy_kwargs={"net_arch": [16, 16]}, seed=0, device="cpu")
    seen = np.random.default_rng(0).uniform(0.0, 1.0, (5, GROUND.task.observation_dim)).astype(np.float32)
    policy = MLP(GROUND, _layers(model))
    assert policy.of_many(seen) == pytest.approx(model.predict(seen, deterministic=True)[0], abs=1e-6)
    assert policy.sizes == (26, 16, 16, 2)


def test_it_learns_from_its_proposals_and_pays_for_corrections(env):
    """Straight on at full speed, until the filter corrects it: the scaled reward of the log, less the penalty."""
    observed = env.reset()
    assert observed.shape == (2, 26) and [message.episode for message in env.taken] == [0, 0]
    corrected = 0
    for _ in range(60):
        before = len(env.taken)
        _, rewards, ended, infos = env.step(np.tile(np.array([0.25, 0.0], np.float32), (2, 1)))
        steps = env.taken[before : before + 2]
        assert rewards == pytest.approx([0.1 * (step.reward - step.penalty) for step in steps], abs=1e-5)
        assert [step.terminated or step.truncated for step in steps] == ended.tolist()
        assert all("terminal_observation" in info for info, end in zip(infos, ended, strict=True) if end)
        corrected += sum(step.penalty > 0.0 for step in steps)
        assert not any(step.collision for step in steps)
    assert corrected > 0

"""SAC beside our learner: the same robots and steps, and a policy that the same evaluations drive."""

import numpy as np
import pytest
from stable_baselines3 import SAC

from brakeline.deploy.batch_robots import BatchRobots
from brakeline.deploy.experiments.sac_training import RobotsAsVecEnv, _buffer, _layers
from brakeline.learner.learner_config import TD3Config
from brakeline.learner.symmetry import symmetry_maps, symmetry_matrices
from brakeline.messaging.policy_weights import MLP
from brakeline.messaging.task import robot_with_task
from brakeline.safety.filter.filter import Filter
from brakeline.sim.navigation_env import action_and_observation_space

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


def test_in_the_air_it_learns_from_the_images_of_steps_that_our_learner_has():
    robot = robot_with_task("quadrotor")
    action_space, observation_space = action_and_observation_space(robot)
    assert np.array_equal(action_space.low, -action_space.high) and action_space.high[0] == action_space.high[1]
    options = _buffer(robot, TD3Config(batch=16))
    assert "n_steps" not in options, "Stable-Baselines3 ignores it beside a buffer, which has its own"
    make = options["replay_buffer_class"]
    buffer = make(64, observation_space, action_space, device="cpu", n_envs=1, **options["replay_buffer_kwargs"])
    rng = np.random.default_rng(0)
    seen = rng.uniform(0.1, 0.9, (40, robot.task.observation_dim)).astype(np.float32)
    taken = rng.uniform(-1.0, 1.0, (40, robot.action_dim)).astype(np.float32)
    for k in range(39):
        buffer.add(seen[k : k + 1], seen[k + 1 : k + 2], taken[k : k + 1], np.ones(1), np.zeros(1), [{}])

    rows = np.arange(16)
    batch = buffer._get_samples(rows)
    turns = symmetry_matrices(robot)
    for k in rows:
        rays, observed, axes, acted = symmetry_maps(robot, turns[k % len(turns)])
        assert np.array_equal(batch.observations[k], (seen[k][rays] * observed).astype(np.float32))
        assert np.array_equal(batch.actions[k], (taken[k][axes] * acted).astype(np.float32))
        assert np.array_equal(batch.next_observations[k], (seen[k + 3][rays] * observed).astype(np.float32))
    assert batch.rewards.numpy() == pytest.approx(1.0 + 0.99 + 0.99**2) and len(turns) == 8


@pytest.mark.parametrize(("robot", "symmetric"), [("ground", True), ("quadrotor", False)])
def test_without_images_the_buffer_is_that_of_stable_baselines(robot, symmetric):
    assert _buffer(robot_with_task(robot), TD3Config(symmetric=symmetric)) == {"n_steps": 3}

"""Train Stable-Baselines3's SAC (Haarnoja et al. 2018) from many robots at once, with or without a filter.

The learner gets what any user of `BatchSafetyWrapper` gets: its own proposal as the action, and the reward less the
penalty for a correction. The scale of rewards is that of our TD3. If our TD3 learns from turned and mirrored steps
(learner/symmetry.py), so does SAC. The deterministic policy is a network of the same kind as ours, so the same
evaluations can drive it.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from stable_baselines3 import SAC
from stable_baselines3.common.buffers import NStepReplayBuffer
from stable_baselines3.common.type_aliases import ReplayBufferSamples
from stable_baselines3.common.vec_env import VecEnv

from brakeline.actors.episode_runner import ActorIdentity
from brakeline.deploy.batch_robots import BatchRobots
from brakeline.deploy.experiments.comparison_cells import CellConfig
from brakeline.deploy.experiments.trials import Begin, Take
from brakeline.deploy.run.batch_trainer import actor_names
from brakeline.learner.learner_config import TD3Config
from brakeline.learner.symmetry import SymmetryAugmentation
from brakeline.messaging.policy_weights import MLP
from brakeline.messaging.task import RobotWithTask
from brakeline.safety.filter.batch.row_by_row import BatchMethod
from brakeline.sim.navigation_env import action_and_observation_space

CAPACITY = 200_000  # steps of the replay buffer, as our learner's


class ImagesReplayBuffer(NStepReplayBuffer):
    """The n-step buffer of Stable-Baselines3, whose batches hold the images of steps in a turned or mirrored world.

    The buffer stores actions that Stable-Baselines3 scaled to [-1, 1]. The image of a scaled action is the scaled image
    of the action, because inputs that change places have equal ranges, and the range of an input that changes its sign
    is symmetric about zero.
    """

    def __init__(self, *args: Any, images: SymmetryAugmentation, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        self._images = images

    def _get_samples(self, batch_inds: NDArray[np.intp], env: Any = None) -> ReplayBufferSamples:
        samples = super()._get_samples(batch_inds, env)
        names = ("observations", "actions", "next_observations")
        return samples._replace(**{name: self._image(getattr(samples, name)) for name in names})

    def _image(self, rows: torch.Tensor) -> torch.Tensor:
        return torch.as_tensor(self._images.rows(rows.numpy()))


class RobotsAsVecEnv(VecEnv):
    """The robots of a batch as an environment of Stable-Baselines3, which logs what they do."""

    def __init__(
        self, robot: RobotWithTask, robots: BatchRobots, reward_scale: float, take: Take, begin: Begin
    ) -> None:
        action_space, observation_space = action_and_observation_space(robot)
        self.render_mode = None
        super().__init__(len(robots.names), observation_space, action_space)
        self._robots, self._reward_scale, self._take, self._begin = robots, reward_scale, take, begin

    def reset(self) -> NDArray[np.float32]:
        self._announce(list(range(self.num_envs)))
        return self._robots.observations

    def step_async(self, actions: NDArray[np.float32]) -> None:
        self._robots.begin_period(np.asarray(actions, dtype=float))

    def step_wait(self) -> tuple[Any, NDArray[np.float32], NDArray[np.bool_], list[dict[str, Any]]]:
        steps, begun = self._robots.end_period()
        for step in steps:
            self._take(step)
        self._announce(begun)
        rewards = np.array([step.reward - step.penalty for step in steps], np.float32) * np.float32(self._reward_scale)
        ended = np.array([step.terminated or step.truncated for step in steps])
        infos: list[dict[str, Any]] = [{} for _ in steps]
        for info, step in zip(infos, steps, strict=True):
            if step.terminated or step.truncated:  # what Stable-Baselines3 needs of the last step of an episode
                info["terminal_observation"] = np.array(step.next_observation, np.float32)
                info["TimeLimit.truncated"] = step.truncated and not step.terminated
        return self._robots.observations, rewards, ended, infos

    def close(self) -> None:
        self._robots.close()

    def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]:
        return [getattr(self, attr_name)] * self.num_envs

    def set_attr(self, attr_name: str, value: Any, indices: Any = None) -> None:
        raise NotImplementedError("the robots of a batch have no attributes of their own")

    def env_method(self, method_name: str, *method_args: Any, indices: Any = None, **method_kwargs: Any) -> list[Any]:
        raise NotImplementedError("the robots of a batch have no methods of their own")

    def env_is_wrapped(self, wrapper_class: Any, indices: Any = None) -> list[bool]:
        return [False] * self.num_envs

    def _announce(self, begun: list[int]) -> None:
        for number in begun:
            self._begin(self._robots.episode_message(number))


def train_sac(
    robot: RobotWithTask, safety: BatchMethod | None, cell: CellConfig, take: Take, begin: Begin
) -> tuple[MLP, int]:
    """Train the policy of a cell in its first arena, and return it with the number of updates.

    Args:
        safety: the filter or rival. None: each robot executes what it proposes.
        cell: gives the settings. SAC uses the settings of TD3 that it has too, and the learning rate of the actor.
        take, begin: called with each step, and with the description of each episode.
    """
    torch.set_num_threads(1)
    config, actors, episodes = cell.td3, actor_names(cell.name, cell.robots), [0] * cell.robots

    def next_episode(number: int) -> tuple[int, int]:
        episodes[number] += 1
        episode = episodes[number] - 1
        return episode, ActorIdentity(actors[number], number, cell.seed).episode_seed(episode)

    options: dict[str, Any] = {"arena": cell.arenas[0], "seed_key": cell.seed, "penalty": cell.penalty}
    robots = BatchRobots(robot, actors, safety, next_episode, **options)
    env = RobotsAsVecEnv(robot, robots, config.reward_scale, take, begin)
    try:
        model = SAC(
            "MlpPolicy",
            env,
            learning_rate=config.actor_rate,
            buffer_size=CAPACITY,
            **_buffer(robot, config),
            learning_starts=config.warmup,
            batch_size=config.batch,
            tau=config.tau,
            gamma=config.gamma,
            gradient_steps=max(1, round(config.updates_per_step * cell.robots)),  # for one step of each robot
            policy_kwargs={"net_arch": list(config.hidden)},
            seed=cell.seed,
            device="cpu",
        )
        model.learn(total_timesteps=cell.steps)
    finally:
        env.close()
    return MLP(robot, _layers(model)), int(model._n_updates)


def _buffer(robot: RobotWithTask, config: TD3Config) -> dict[str, Any]:
    """Return the options of SAC for n-step returns, and for images of steps if our learner uses images."""
    if not config.symmetric or robot.task.symmetry == "none":
        return {"n_steps": config.n_step}
    images = SymmetryAugmentation(robot, config.batch)
    options = {"n_steps": config.n_step, "gamma": config.gamma, "images": images}
    return {"replay_buffer_class": ImagesReplayBuffer, "replay_buffer_kwargs": options}


def _layers(model: SAC) -> list[tuple[NDArray[np.float32], NDArray[np.float32]]]:
    """Return the layers of the deterministic policy: tanh of the mean."""
    modules = list(model.actor.latent_pi.modules())
    linear = [layer for layer in (*modules, model.actor.mu) if isinstance(layer, torch.nn.Linear)]
    return [(layer.weight.detach().numpy().copy(), layer.bias.detach().numpy().copy()) for layer in linear]

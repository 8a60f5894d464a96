"""Train a policy in another author's environment behind the safety service, with the learner's TD3.

python train.py car --steps 60000 --out car.jsonl

The environment asks the service in every step, in training as afterwards. The learner learns from the executed action,
and from the proposed one with a penalty (`learner/n_step.py`). The script writes a line of JSON with the cost of each
episode, and stores the policy beside the robot's description; `run.py car trained` drives it.
"""

from __future__ import annotations

import argparse
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[2]))

from brakeline import SafetyClient
from brakeline.learner.learner_config import TD3Config
from brakeline.learner.n_step import ActorStep, NStepWindows
from brakeline.learner.replay import Batch, ReplayBuffer
from brakeline.learner.td3 import TD3
from brakeline.safety import action_mapping
from examples.foreign.adapter import FOLDERS, Adapter, load_adapter
from examples.foreign.run import DEADLINE, EpisodeFigures, filtered_task, report
from examples.foreign.trained import TrainedPolicy, Vector, mean_and_spread, normalised

CONFIG = TD3Config(
    hidden=(128, 128), gamma=0.98, reward_scale=1.0, actor_rate=5e-4, critic_rate=5e-4, exploration_noise=0.2
)
LONGEST_HOLD = 10  # periods of one random action, before there is a policy
SAME_ACTION = 1e-6  # of an input's half range: a smaller difference between executed and proposed is rounding


class Learner:
    """TD3 of observations that are normalised by the mean and spread of the first, random steps."""

    def __init__(self, adapter: Adapter, size: int, steps: int, seed: int) -> None:
        """size: of an observation; steps: of the training."""
        robot, config = adapter.robot, CONFIG
        dims = size, robot.action_dim
        self.robot, self.rng = robot, np.random.default_rng(seed)
        self.actions = action_mapping.normalised(robot)
        self.td3 = TD3(*dims, config, seed)
        self.windows = NStepWindows(config.n_step, config.gamma, config.stored)
        self.replay, self.batch = ReplayBuffer(2 * steps, *dims), Batch(config.batch, *dims)
        self.policy: TrainedPolicy | None = None
        self._random_action, self._periods_left = np.zeros(robot.action_dim), 0

    def propose(self, observation: Any) -> Vector:
        """Return an action in [-1, 1]: the policy's with noise, at first a random one for some periods."""
        size = self.robot.action_dim
        if self.policy is not None:
            noise = self.rng.normal(0.0, CONFIG.exploration_noise, size)
            return np.clip(self.policy.action(observation) + noise, -1.0, 1.0).astype(np.float32)
        if self._periods_left == 0:
            self._random_action = self.rng.uniform(-1.0, 1.0, size)
            self._periods_left = self.rng.integers(1, LONGEST_HOLD + 1)
        self._periods_left -= 1
        return self._random_action.astype(np.float32)

    def learn(self, step: ActorStep) -> None:
        """Store a step, and update the policy once there are enough steps."""
        for transition in self.windows.push(self.robot.name, step):
            self.replay.insert(transition)
        if self.policy is None:
            if len(self.replay) < CONFIG.warmup:
                return
            stored = self.replay.state().tensor("observation", (None, None), "float32")
            self._mean, self._spread = mean_and_spread(stored)
        self.replay.sample(self.rng, self.batch)
        for array in self.batch.observation, self.batch.next_observation:
            array.numpy()[:] = normalised(array.numpy(), self._mean, self._spread)
        self.td3.update(self.batch)
        self.policy = TrainedPolicy(self.robot, self.td3.policy_layers(), self._mean, self._spread)


def episode(env: Any, learner: Learner, number: int) -> EpisodeFigures:
    """Drive and learn for one episode."""
    figures, step, ended = EpisodeFigures(), 0, False
    observation, _ = env.reset(seed=10_000 + number)  # none of the seeds of the evaluation
    while not ended:
        proposed = learner.propose(observation)
        after, reward, terminated, truncated, info = env.step(learner.actions.action_to_control(proposed))
        executed = learner.actions.control_to_action(info["diagnostics"]["executed"]).astype(np.float32)
        executed = proposed if np.abs(executed - proposed).max() < SAME_ACTION else executed
        unpenalised = reward + info["penalty"]
        figures.add(unpenalised, info)
        step, ended = step + 1, terminated or truncated
        outcome = unpenalised, info["penalty"], after, terminated, truncated
        learner.learn(ActorStep(number, step, observation, executed, proposed, *outcome))
        observation = after
    return figures


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("robot", choices=tuple(FOLDERS))
    parser.add_argument("--steps", type=int, default=60_000, help="steps; the script finishes the last episode")
    parser.add_argument(
        "--penalty", type=float, default=0.02, help="penalty for a correction by an input's whole range"
    )
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--connect", default="tcp/127.0.0.1:7450", help="the service")
    parser.add_argument("--out", type=Path, required=True, help="file to append the lines to")
    options = parser.parse_args()
    adapter, steps, number, cost = load_adapter(options.robot), 0, 0, 0.0
    started = time.perf_counter()
    with SafetyClient.open(options.connect, adapter.robot, DEADLINE, name="client.training") as client:
        env = filtered_task(adapter, client, options.penalty)
        learner = Learner(adapter, env.observation_space.shape[0], options.steps, options.seed)
        while steps < options.steps:
            figures = episode(env, learner, number).as_json()
            steps, number, cost = steps + figures["steps"], number + 1, cost + figures["cost"]
            report(
                {"robot": options.robot, "policy": "training", "filter": True, "seed": number} | figures, options.out
            )
            if learner.policy is not None:
                seconds = round(time.perf_counter() - started)
                about = {"robot": options.robot, "task": adapter.task, "steps": steps, "episodes": number}
                about |= {"cost": cost, "seed": options.seed, "seconds": seconds}
                learner.policy.save(adapter.trained, about)


if __name__ == "__main__":
    main()

"""Trains a policy of another author's environment behind the safety service, with the learner's TD3.

python train.py car --steps 60000 --out car.jsonl

The environment asks the service for every step, in training as afterwards. What is learned from is what was executed,
and what was proposed with a penalty (`learner/n_step.py`). Every episode is a line of JSON with its cost. The policy
is stored beside the robot's description; `run.py car trained` drives it.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[2]))

from brakeline.learner.learner_config import TD3Config
from brakeline.learner.n_step import ActorStep, NStepWindows
from brakeline.learner.replay import Batch, ReplayBuffer
from brakeline.learner.td3 import TD3
from brakeline.safety.action_mapping import normalised
from brakeline.safety.service.client import SafetyClient
from examples.foreign.adapter import Adapter
from examples.foreign.robots import FOLDERS, adapter_of
from examples.foreign.run import DEADLINE, Tally, behind
from examples.foreign.trained import Trained, Vector, scale, seen

CONFIG = TD3Config(
    hidden=(128, 128), gamma=0.98, reward_scale=1.0, actor_rate=5e-4, critic_rate=5e-4, exploration_noise=0.2
)
HELD = 10  # periods at most of an input at random, before there is a policy
SAME = 1e-6  # of an input's half range: what was executed is what was proposed


class LearnedPolicy:
    """TD3 of observations as they come: they are normalised by what the steps at random saw."""

    def __init__(self, adapter: Adapter, size: int, steps: int, seed: int) -> None:
        robot, config = adapter.robot, CONFIG
        dims = size, robot.action_dim
        self.robot, self.rng = robot, np.random.default_rng(seed)
        self.between = normalised(robot)
        self.td3 = TD3(*dims, config, seed)
        self.windows = NStepWindows(config.n_step, config.gamma, config.stored)
        self.replay, self.batch = ReplayBuffer(2 * steps, *dims), Batch(config.batch, *dims)
        self.policy: Trained | None = None
        self._held, self._left = np.zeros(robot.action_dim), 0

    def proposed(self, observation: Any) -> Vector:
        """In [-1, 1]: the policy with noise, at first held at random."""
        if self.policy is not None:
            noise = self.rng.normal(0.0, CONFIG.exploration_noise, self.robot.action_dim)
            return np.clip(self.policy.normalised(observation) + noise, -1.0, 1.0).astype(np.float32)
        if self._left == 0:
            self._held, self._left = self.rng.uniform(-1.0, 1.0, self.robot.action_dim), self.rng.integers(1, HELD + 1)
        self._left -= 1
        return self._held.astype(np.float32)

    def learn(self, move: ActorStep) -> None:
        """Takes a step in, and makes an update as soon as there is enough to learn from."""
        for transition in self.windows.push(self.robot.name, move):
            self.replay.insert(transition)
        if self.policy is None:
            if len(self.replay) < CONFIG.warmup:
                return
            self._middle, self._spread = scale(self.replay.state().tensor("observation", (None, None), "float32"))
        self.replay.sample(self.rng, self.batch)
        for array in self.batch.observation, self.batch.next_observation:
            array.numpy()[:] = seen(array.numpy(), self._middle, self._spread)
        self.td3.update(self.batch)
        self.policy = Trained(self.robot, self.td3.policy_layers(), self._middle, self._spread)


def episode(env: Any, pupil: LearnedPolicy, number: int) -> Tally:
    tally, step, ended = Tally(), 0, False
    observation, _ = env.reset(seed=10_000 + number)  # none of those that are counted afterwards
    while not ended:
        wanted = pupil.proposed(observation)
        after, paid, terminated, truncated, info = env.step(pupil.between.action_to_control(wanted))
        executed = pupil.between.control_to_action(info["diagnostics"]["executed"]).astype(np.float32)
        executed = wanted if np.abs(executed - wanted).max() < SAME else executed
        reward = paid + info["penalty"]
        tally.add(reward, info)
        step, ended = step + 1, terminated or truncated
        told = reward, info["penalty"], after, terminated, truncated
        pupil.learn(ActorStep(number, step, observation, executed, wanted, *told))
        observation = after
    return tally


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("robot", choices=tuple(FOLDERS))
    parser.add_argument("--steps", type=int, default=60_000, help="the episode in which they end is finished")
    parser.add_argument("--penalty", type=float, default=0.02, help="of an input corrected by its whole range")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--connect", default="tcp/127.0.0.1:7450", help="the service")
    parser.add_argument("--out", type=Path, required=True, help="to which the episodes' lines are added")
    given = parser.parse_args()
    adapter, done, number, cost = adapter_of(given.robot), 0, 0, 0.0
    started = time.perf_counter()
    with SafetyClient.open(given.connect, adapter.robot, DEADLINE, name="client.training") as client:
        env = behind(adapter, client, given.penalty)
        pupil = LearnedPolicy(adapter, env.observation_space.shape[0], given.steps, given.seed)
        while done < given.steps:
            told = episode(env, pupil, number).told()
            done, number, cost = done + told["steps"], number + 1, cost + told["cost"]
            line = json.dumps({"robot": given.robot, "policy": "training", "filter": True, "seed": number} | told)
            print(line, flush=True)
            with given.out.open("a") as file:
                file.write(line + "\n")
            if pupil.policy is not None:
                seconds = round(time.perf_counter() - started)
                about = {"robot": given.robot, "task": adapter.task, "steps": done, "episodes": number}
                pupil.policy.save(adapter.trained, about | {"cost": cost, "seed": given.seed, "seconds": seconds})


if __name__ == "__main__":
    main()

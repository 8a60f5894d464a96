"""Measure TD3 updates a second beside the same with torch.nn and torch.optim, and the forward pass of the policy."""

from __future__ import annotations

import copy
from functools import partial

import numpy as np
import torch
from torch import nn

from benchmarks.timing import Figures, timed
from brakeline.learner.learner_config import TD3Config
from brakeline.learner.replay import Batch
from brakeline.learner.td3 import TD3
from brakeline.messaging.policy_weights import MLP
from brakeline.messaging.task import robot_with_task

UPDATES = 100


def network(inputs: int, outputs: int) -> nn.Sequential:
    """Return a network with two hidden layers."""
    return nn.Sequential(nn.Linear(inputs, 256), nn.ReLU(), nn.Linear(256, 256), nn.ReLU(), nn.Linear(256, outputs))


class Plain:
    """TD3 as in a textbook, the peer of `brakeline.learner.td3`."""

    def __init__(self, config: TD3Config, observations: int, actions: int) -> None:
        self.config, self.updates = config, 0
        self.actor = nn.Sequential(network(observations, actions), nn.Tanh())
        self.critics = nn.ModuleList(network(observations + actions, 1) for _ in range(2))
        self.targets = copy.deepcopy(self.actor), copy.deepcopy(self.critics)
        self.actor_optimiser = torch.optim.Adam(self.actor.parameters(), config.actor_rate)
        self.critic_optimiser = torch.optim.Adam(self.critics.parameters(), config.critic_rate)

    def update(self, s: torch.Tensor, a: torch.Tensor, r: torch.Tensor, n: torch.Tensor) -> None:
        """Learn from a batch of observations, actions, rewards (B, 1) and next observations."""
        c, (actor, critics) = self.config, self.targets
        with torch.no_grad():
            noise = (torch.randn_like(a) * c.target_noise).clamp(-c.target_noise_clip, c.target_noise_clip)
            joint = torch.cat([n, (actor(n) + noise).clamp(-1, 1)], 1)
            y = r + c.gamma * torch.minimum(critics[0](joint), critics[1](joint))
        loss = torch.stack([nn.functional.mse_loss(q(torch.cat([s, a], 1)), y) for q in self.critics]).sum()
        self.critic_optimiser.zero_grad()
        loss.backward()  # type: ignore[no-untyped-call]
        self.critic_optimiser.step()
        self.updates += 1
        if self.updates % c.policy_delay == 0:
            gain = -self.critics[0](torch.cat([s, self.actor(s)], 1)).mean()
            self.actor_optimiser.zero_grad()
            gain.backward()
            self.actor_optimiser.step()
            with torch.no_grad():
                for target, source in zip(self.targets, (self.actor, self.critics), strict=True):
                    for slow, fast in zip(target.parameters(), source.parameters(), strict=True):
                        slow.lerp_(fast, self.config.tau)


def run() -> Figures:
    """Return a row for each implementation and batch size."""
    torch.set_num_threads(1)
    robot = robot_with_task("ground")
    observations, actions = robot.task.observation_dim, robot.action_dim
    rng = np.random.default_rng(0)
    figures: Figures = {}
    for size in (128, 256):
        config = TD3Config(batch=size)
        batch = Batch(size, observations, actions)
        for field in vars(batch).values():
            if isinstance(field, np.ndarray):
                field[...] = rng.uniform(-1, 1, field.shape)
        ours, plain = TD3(observations, actions, config, seed=0), Plain(config, observations, actions)
        tensors = [torch.rand(size, width) for width in (observations, actions, 1, observations)]
        for name, times in (
            ("ours", timed(partial(ours.update, batch), UPDATES)),
            ("torch.nn and torch.optim", timed(partial(plain.update, *tensors), UPDATES)),
        ):
            figures[f"TD3 update, batch {size}: {name}"] = times | {"updates/s": 1e3 / times["p50 ms"]}
    mlp, seen = MLP.untrained(robot_with_task("ground"), 0), rng.uniform(-1, 1, observations).astype(np.float32)
    actor, tensor = Plain(TD3Config(), observations, actions).actor, torch.rand(1, observations)
    figures["policy forward, NumPy"] = timed(lambda: mlp(seen), 2000)
    with torch.no_grad():
        figures["policy forward, torch"] = timed(lambda: actor(tensor), 2000)
    return figures

"""Measure TD3 updates a second beside the same with torch.nn and torch.optim, and the forward pass of the policy."""

from __future__ import annotations

import copy
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from time import thread_time

import numpy as np
import torch
from torch import nn

from benchmarks.timing import WARM_UP, Figures, timed
from brakeline.learner.learner_config import Precision, TD3Config
from brakeline.learner.replay import Batch
from brakeline.learner.td3 import TD3
from brakeline.messaging.policy_weights import MLP
from brakeline.messaging.task import robot_with_task

OURS: dict[str, Precision] = {"ours": "float32", "ours, bfloat16": "bfloat16"}
UPDATES = 20  # of a block
BLOCKS = 15


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
        c = self.config
        with torch.no_grad():
            noise = (torch.randn_like(a) * c.target_noise).clamp(-c.target_noise_clip, c.target_noise_clip)
            y = r + c.gamma * self.least(torch.cat([n, (self.targets[0](n) + noise).clamp(-1, 1)], 1))
        loss = self.loss(torch.cat([s, a], 1), y)
        self.critic_optimiser.zero_grad()
        loss.backward()  # type: ignore[no-untyped-call]
        self.critic_optimiser.step()
        self.updates += 1
        if self.updates % c.policy_delay == 0:
            gain = -self.first(torch.cat([s, self.actor(s)], 1)).mean()
            self.actor_optimiser.zero_grad()
            gain.backward()  # type: ignore[no-untyped-call]
            self.actor_optimiser.step()
            with torch.no_grad():
                self.follow()

    def least(self, x: torch.Tensor) -> torch.Tensor:
        """Return the least value (B, 1) of the slow critics for inputs (B, in)."""
        return torch.minimum(self.targets[1][0](x), self.targets[1][1](x))

    def loss(self, x: torch.Tensor, y: torch.Tensor) -> torch.Tensor:
        """Return the sum of the critics' mean squared errors."""
        return torch.stack([nn.functional.mse_loss(q(x), y) for q in self.critics]).sum()

    def first(self, x: torch.Tensor) -> torch.Tensor:
        """Return the values (B, 1) of the first critic."""
        values: torch.Tensor = self.critics[0](x)
        return values

    def follow(self) -> None:
        """Move the slow networks towards the others."""
        for target, source in zip(self.targets, (self.actor, self.critics), strict=True):
            for slow, fast in zip(target.parameters(), source.parameters(), strict=True):
                slow.lerp_(fast, self.config.tau)


class Stacked(Plain):
    """The same with the faster parts of torch itself: a product for both critics, fused Adam, grouped averages."""

    def __init__(self, config: TD3Config, observations: int, actions: int) -> None:
        super().__init__(config, observations, actions)
        shapes = [layer.weight.shape for layer in self.critics[0].children() if isinstance(layer, nn.Linear)]
        layers = [(shape, shape[1] ** -0.5) for shape in shapes]
        self.weights = [nn.Parameter(torch.empty(2, i, o).uniform_(-most, most)) for (o, i), most in layers]
        self.biases = [nn.Parameter(torch.zeros(2, 1, o)) for (o, _), _ in layers]
        self.slow_weights, self.slow_biases = (
            [part.detach().clone() for part in parts] for parts in (self.weights, self.biases)
        )
        self.actor_optimiser = torch.optim.Adam(self.actor.parameters(), config.actor_rate, fused=True)
        self.critic_optimiser = torch.optim.Adam([*self.weights, *self.biases], config.critic_rate, fused=True)

    @staticmethod
    def values(x: torch.Tensor, weights: Sequence[torch.Tensor], biases: Sequence[torch.Tensor]) -> torch.Tensor:
        """Return the values (critics, B, 1) of inputs (B, in)."""
        x = x.expand(len(weights[0]), -1, -1)
        for weight, bias in zip(weights[:-1], biases[:-1], strict=True):
            x = torch.baddbmm(bias, x, weight).relu()
        return torch.baddbmm(biases[-1], x, weights[-1])

    def least(self, x: torch.Tensor) -> torch.Tensor:
        return self.values(x, self.slow_weights, self.slow_biases).amin(0)

    def loss(self, x: torch.Tensor, y: torch.Tensor) -> torch.Tensor:
        return 2.0 * (self.values(x, self.weights, self.biases) - y).square().mean()

    def first(self, x: torch.Tensor) -> torch.Tensor:
        return self.values(x, *([part.detach()[:1] for part in parts] for parts in (self.weights, self.biases)))

    def follow(self) -> None:
        fast = [part.detach() for part in (*self.weights, *self.biases, *self.actor.parameters())]
        slow = [*self.slow_weights, *self.slow_biases, *self.targets[0].parameters()]
        torch._foreach_lerp_(slow, fast, self.config.tau)


def in_bfloat16(work: Callable[[], object]) -> Callable[[], None]:
    """Return the same work with torch's automatic mixed precision (bfloat16)."""

    def mixed() -> None:
        with torch.autocast("cpu", dtype=torch.bfloat16):
            work()

    return mixed


def products(config: TD3Config, inputs: int) -> Callable[[], None]:
    """Return the matrix products of an update with hidden layers of 256, and nothing else: no code is faster."""
    size, width = config.batch, config.hidden[0]
    x, wide, narrow = torch.rand(size, width), torch.rand(width, width), torch.rand(inputs, width)
    out, gradient, first = torch.zeros(size, width), torch.zeros(width, width), torch.zeros(inputs, width)

    turn = False

    def work() -> None:
        nonlocal turn
        turn = not turn
        # Of the critics: three forward passes and two backward; of the actor, every other time, two and two.
        forward, backward = (5 + 2 * turn, 2 + turn)
        for _ in range(forward):
            torch.mm(x[:, :inputs], narrow, out=out)
            torch.mm(x, wide, out=out)
        for _ in range(backward):
            torch.mm(x.T, x, out=gradient)
            torch.mm(x[:, :inputs].T, x, out=first)
        for _ in range(2 + 2 * turn):
            torch.mm(x, wide, out=out)

    return work


def in_turn(ways: dict[str, Callable[[], object]], peer: str) -> Figures:
    """Return each way's least processor time of a block of calls, and its speed as a multiple of the peer's.

    The blocks of the ways take turns, because other load on the machine changes the speed of all.
    """
    blocks: dict[str, list[float]] = {name: [] for name in ways}
    for call in ways.values():
        for _ in range(WARM_UP):
            call()
    for _ in range(BLOCKS):
        for name, call in ways.items():
            before = thread_time()
            for _ in range(UPDATES):
                call()
            blocks[name].append((thread_time() - before) / UPDATES)
    figures: Figures = {}
    for name, seconds in blocks.items():
        times = np.array(blocks[peer]) / np.array(seconds)
        low, middle, high = np.percentile(times, (10, 50, 90))
        least = min(seconds)
        figures[name] = {"ms": 1e3 * least, "updates/s": 1.0 / least, "times": middle, "p10": low, "p90": high}
    return figures


def run() -> Figures:
    """Return a row for each implementation and batch size: `times` the speed of torch.nn, with percentiles."""
    torch.set_num_threads(1)
    robot = robot_with_task("ground")
    observations, actions = robot.task.observation_dim, robot.action_dim
    rng = np.random.default_rng(0)
    figures: Figures = {}
    for size in (128, 256):
        config = TD3Config(batch=size)
        batch = Batch(size, observations, actions)
        for array in batch.arrays:
            array[...] = rng.uniform(-1, 1, array.shape)
        tensors = [torch.rand(size, width) for width in (observations, actions, 1, observations)]
        peers = {"torch.nn and torch.optim": Plain, "the faster parts of torch": Stacked}
        ways: dict[str, Callable[[], object]] = {}
        for name, precision in OURS.items():
            learner = TD3(observations, actions, replace(config, precision=precision), 0)
            ways[name] = partial(learner.update, batch)
        for name, kind in peers.items():
            ways[name] = partial(kind(config, observations, actions).update, *tensors)
            ways[f"{name}, bfloat16"] = in_bfloat16(partial(kind(config, observations, actions).update, *tensors))
        ways["the matrix products alone"] = products(config, observations + actions)
        rows = in_turn(ways, "torch.nn and torch.optim")
        figures |= {f"TD3 update, batch {size}: {name}": row for name, row in rows.items()}
    mlp, seen = MLP.untrained(robot, 0), rng.uniform(-1, 1, observations).astype(np.float32)
    actor, tensor = Plain(TD3Config(), observations, actions).actor, torch.rand(1, observations)
    figures["policy forward, NumPy"] = timed(lambda: mlp(seen), 2000)
    with torch.no_grad():
        figures["policy forward, torch"] = timed(lambda: actor(tensor), 2000)
    return figures

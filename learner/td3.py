"""TD3 (Fujimoto et al. 2018): twin critics, target smoothing and delayed updates of the actor.

Each coordinate of an action is normalised to [−1, 1]. A transition spans k ≤ n steps (`learner/n_step.py`):

    y     = c·(R − f P − λ C) + d · min_i Q̄_i(s', clip(π̄(s') + ε, −1, 1)),   ε = clip(N(0, σ²), −η, η)
    L_Q   = Σ_i mean (Q_i(s, a) − y)²
    L_π   = −mean Q_1(s, π(s)) + β mean m ‖π(s) − a‖²              every `policy_delay`-th update, then
    θ̄     ← θ̄ + τ (θ − θ̄)

with R = Σ_j γ^j r_j over the k steps, P and C the same sums of penalties for corrections and of costs, λ the weight of
costs (0 unless a multiplier sets it; `learner/lagrange.py`), d = γ^k (0 at a true end), and c the reward scale. The
factor f on penalties may grow during the training. β is the weight of imitation, and m is 1 where the filter executed a
in place of another proposal.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from brakeline.learner.checkpoint import PartState
from brakeline.learner.learner_config import TD3Config
from brakeline.learner.networks import Adam, Network
from brakeline.learner.replay import Batch


@dataclass
class Losses:
    """The losses of the last updates."""

    critic: float = 0.0
    actor: float = 0.0
    mean_q: float = 0.0


class TD3:
    """The networks, their targets and their optimisers."""

    def __init__(self, observation_dim: int, action_dim: int, config: TD3Config, seed: int) -> None:
        torch.set_num_threads(1)  # more threads than cores make all processes ten times slower
        self.config, self.updates, self.losses = config, 0, Losses()
        self.cost_weight, self.penalty_factor = 0.0, 1.0  # λ, f
        self._generator = torch.Generator().manual_seed(seed)
        batch, joint = config.batch, observation_dim + action_dim
        actor_sizes = (observation_dim, *config.hidden, action_dim)
        critic_sizes = (joint, *config.hidden, 1)
        self.actor = Network(actor_sizes, 1, batch, config.precision)
        self.critics = Network(critic_sizes, 2, batch, config.precision)
        self.actor.initialise(self._generator)
        self.critics.initialise(self._generator)
        self.target_actor = Network(actor_sizes, 1, batch, config.precision, self.actor.parameters.clone())
        self.target_critics = Network(critic_sizes, 2, batch, config.precision, self.critics.parameters.clone())
        self._first_critic = self.critics.first()
        self.actor_adam = Adam(self.actor.parameters, config.actor_rate)
        self.critic_adam = Adam(self.critics.parameters, config.critic_rate)
        self._observation = slice(0, observation_dim)
        self._action = slice(observation_dim, joint)
        self._joint = torch.zeros(1, batch, joint)  # working memory: [observation, action]
        self._noise = torch.zeros(1, batch, action_dim)
        self._target = torch.zeros(1, batch, 1)

    def update(self, batch: Batch) -> None:
        torch.set_flush_denormal(True)  # the moments of inactive units decay to denormals, which double the time
        self._update_critics(batch)
        self.updates += 1
        if self.updates % self.config.policy_delay == 0:
            self._update_actor(batch)
            self.target_actor.parameters.lerp_(self.actor.parameters, self.config.tau)
            self.target_critics.parameters.lerp_(self.critics.parameters, self.config.tau)
        torch.set_flush_denormal(False)  # the setting is the whole thread's

    def target(self, batch: Batch) -> Tensor:
        """Return y (1, batch, 1)."""
        config = self.config
        noise = self._noise.normal_(0.0, 1.0, generator=self._generator).mul_(config.target_noise)
        noise.clamp_(-config.target_noise_clip, config.target_noise_clip)
        action = self.target_actor.forward(batch.next_observation).tanh_().add_(noise).clamp_(-1.0, 1.0)
        value = self.target_critics.forward(self._pair(batch.next_observation, action)).amin(dim=0, keepdim=True)
        torch.mul(value, batch.discount, out=self._target)
        if self.cost_weight:
            self._target.add_(batch.cost, alpha=-config.reward_scale * self.cost_weight)
        self._target.add_(batch.penalty, alpha=-config.reward_scale * self.penalty_factor)
        return self._target.add_(batch.reward, alpha=config.reward_scale)

    def _pair(self, observation: Tensor, action: Tensor) -> Tensor:
        self._joint[:, :, self._observation] = observation
        self._joint[:, :, self._action] = action
        return self._joint

    def _update_critics(self, batch: Batch) -> None:
        target = self.target(batch)
        value = self.critics.forward(self._pair(batch.observation, batch.action))
        self.losses.mean_q = float(value.mean())
        error = value.sub_(target)
        self.losses.critic = float(error.flatten().dot(error.flatten())) / self.config.batch
        self.critic_adam.step(self.critics.parameter_gradient(error.mul_(2.0 / self.config.batch)))

    def _update_actor(self, batch: Batch) -> None:
        action = self.actor.forward(batch.observation).tanh_()
        value = self._first_critic.forward(self._pair(batch.observation, action))
        self.losses.actor = -float(value.mean())
        dvalue = value.fill_(-1.0 / self.config.batch)
        daction = self._first_critic.input_gradient(dvalue, self._action)
        if (weight := self.config.imitation) > 0.0:
            daction = daction + (2.0 * weight / self.config.batch) * batch.imitated * (action - batch.action)
        self.actor_adam.step(self.actor.parameter_gradient(daction * (1.0 - action * action)))

    def finite(self, batch: Batch) -> bool:
        """Return whether the losses, all weights and the actions in a batch's states are finite numbers."""
        losses = self.losses
        if not math.isfinite(losses.critic + losses.actor + losses.mean_q):
            return False
        tensors = (*self._tensors().values(), self.actor.forward(batch.observation).tanh_())
        return all(bool(torch.isfinite(tensor).all()) for tensor in tensors)

    def policy_layers(self) -> list[tuple[NDArray[np.float32], NDArray[np.float32]]]:
        """Return copies of the weight (out, in) and bias (out,) of the actor's layers."""
        return [(layer.weight[0].numpy().copy(), layer.bias[0, 0].numpy().copy()) for layer in self.actor.layers]

    def _tensors(self) -> dict[str, Tensor]:
        return {
            "actor": self.actor.parameters,
            "critics": self.critics.parameters,
            "target_actor": self.target_actor.parameters,
            "target_critics": self.target_critics.parameters,
            "actor_mean": self.actor_adam.mean,
            "actor_square": self.actor_adam.square,
            "critic_mean": self.critic_adam.mean,
            "critic_square": self.critic_adam.square,
        }

    def state(self) -> PartState:
        tensors = {name: tensor.numpy() for name, tensor in self._tensors().items()}
        tensors["generator"] = self._generator.get_state().numpy()
        counts = {"updates": self.updates, "actor_adam": self.actor_adam.count, "critic_adam": self.critic_adam.count}
        return PartState(tensors, counts)

    def restore(self, state: PartState) -> None:
        """Take over the state of a checkpoint."""
        for name, tensor in self._tensors().items():
            tensor.copy_(torch.from_numpy(state.tensor(name, tuple(tensor.shape), "float32").copy()))
        generator = state.tensor("generator", tuple(self._generator.get_state().shape), "uint8")
        self._generator.set_state(torch.from_numpy(generator.copy()))
        self.updates = state.integer("updates")
        self.actor_adam.count = state.integer("actor_adam")
        self.critic_adam.count = state.integer("critic_adam")

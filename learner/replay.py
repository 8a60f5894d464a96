"""The replay buffer: one ring of transitions, shared by all actors of a robot."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from brakeline.errors import BadState
from brakeline.learner.checkpoint_state import PartState

Vector = NDArray[np.float32]


class Transition(NamedTuple):
    """k ≥ 1 steps of one episode: s, a, R = Σ_j γ^j r_j, d = γ^k (0 at a true end), s' after the k-th."""

    observation: Vector
    action: Vector  # the first of the k, normalised to [−1, 1]
    reward: float
    discount: float
    next_observation: Vector


class Batch:
    """Transitions drawn together, as torch and NumPy see the same memory; refilled by every `ReplayBuffer.sample`.

    Shapes: observation, next_observation (1, batch, obs), action (1, batch, act), reward, discount (1, batch, 1).
    """

    def __init__(self, size: int, observation_dim: int, action_dim: int) -> None:
        widths = (observation_dim, action_dim, 1, 1, observation_dim)
        # Torch aligns what it allocates; by NumPy's alignment the last bits of a product could differ from run to run.
        tensors = [torch.zeros(1, size, width) for width in widths]
        self.arrays = tuple(tensor[0].numpy() for tensor in tensors)
        self.observation, self.action, self.reward, self.discount, self.next_observation = tensors

    def __len__(self) -> int:
        return len(self.arrays[0])


class ReplayBuffer:
    """The last `capacity` transitions, drawn uniformly with replacement."""

    NAMES = ("observation", "action", "reward", "discount", "next_observation")

    def __init__(self, capacity: int, observation_dim: int, action_dim: int) -> None:
        self.capacity, self.size, self._next = capacity, 0, 0
        widths = (observation_dim, action_dim, 1, 1, observation_dim)
        self._arrays = tuple(np.zeros((capacity, width), np.float32) for width in widths)

    def __len__(self) -> int:
        return self.size

    def insert(self, transition: Transition) -> None:
        """Writes over the oldest one when full."""
        for array, value in zip(self._arrays, transition, strict=True):
            array[self._next] = np.asarray(value)
        self._next = (self._next + 1) % self.capacity
        self.size = min(self.size + 1, self.capacity)

    def sample(self, generator: np.random.Generator, batch: Batch) -> None:
        if self.size == 0:
            raise ValueError("nothing to sample from")
        rows = generator.integers(self.size, size=len(batch))
        for array, out in zip(self._arrays, batch.arrays, strict=True):
            np.take(array, rows, axis=0, out=out, mode="clip")  # "raise", the default, would copy the whole of `out`

    def state(self) -> PartState:
        """The filled rows as they lie, so that the same draw finds the same rows again."""
        tensors = {name: array[: self.size] for name, array in zip(self.NAMES, self._arrays, strict=True)}
        return PartState(tensors, {"capacity": self.capacity, "next": self._next})

    def restore(self, state: PartState) -> None:
        if state.integer("capacity") != self.capacity:
            raise BadState(f"capacity: {state.integer('capacity')} where {self.capacity} belongs")
        size = len(state.tensor("reward", (None, 1), "float32"))
        at = state.integer("next")
        full = size == self.capacity
        if size > self.capacity or not (0 <= at < size if full else at == size):
            raise BadState(f"next: {at} with {size} rows")
        for name, array in zip(self.NAMES, self._arrays, strict=True):
            array[:size] = state.tensor(name, (size, array.shape[1]), "float32")
        self.size, self._next = size, at

"""The replay buffer: one ring of transitions, shared by all actors of a robot."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from brakeline.learner.checkpoint import PartState

Vector = NDArray[np.float32]
NAMES = ("observation", "action", "reward", "discount", "next_observation", "cost", "penalty", "imitated")
ADDED = ("penalty", "imitated")  # not in older checkpoints, whose rewards include the penalties


class Transition(NamedTuple):
    """k ≥ 1 steps of an episode: s, a, R = Σ_j γ^j r_j, d = γ^k (0 at a true end), and s' after step k.

    C and P are the same sums of costs and of penalties for corrections.
    """

    observation: Vector
    action: Vector  # of the first step, normalised to [−1, 1]
    reward: float
    discount: float
    next_observation: Vector
    cost: float = 0.0  # c_j is 1 at a collision
    penalty: float = 0.0  # for corrections; R is without it
    imitated: float = 0.0  # 1: the filter executed this action in place of the proposal; the actor may imitate it


def _widths(observation_dim: int, action_dim: int) -> tuple[int, ...]:
    return (observation_dim, action_dim, 1, 1, observation_dim, 1, 1, 1)


class Batch:
    """A batch of transitions that `ReplayBuffer.sample` fills. Torch and NumPy share its memory."""

    def __init__(self, size: int, observation_dim: int, action_dim: int) -> None:
        # Torch aligns its memory; with NumPy's alignment, the last bits of a product could differ from run to run.
        tensors = [torch.zeros(1, size, width) for width in _widths(observation_dim, action_dim)]
        # the same as arrays (batch, width), in the order of `NAMES`
        self.arrays = tuple(tensor[0].numpy() for tensor in tensors)
        # tensors (1, batch, width), in the same order
        self.observation, self.action, self.reward, self.discount, self.next_observation = tensors[:5]
        self.cost, self.penalty, self.imitated = tensors[5:]

    def __len__(self) -> int:
        return len(self.arrays[0])


class ReplayBuffer:
    """The last `capacity` transitions, drawn uniformly with replacement."""

    def __init__(self, capacity: int, observation_dim: int, action_dim: int) -> None:
        self.capacity, self.size, self._next = capacity, 0, 0
        self._arrays = tuple(np.zeros((capacity, width), np.float32) for width in _widths(observation_dim, action_dim))

    def __len__(self) -> int:
        return self.size

    def insert(self, transition: Transition) -> None:
        """Add a transition; a full buffer overwrites its oldest one."""
        values: tuple[Any, ...] = transition
        for array, value in zip(self._arrays, values, strict=True):
            array[self._next] = value
        self._next = (self._next + 1) % self.capacity
        self.size = min(self.size + 1, self.capacity)

    def sample(self, generator: np.random.Generator, batch: Batch) -> None:
        """Fill a batch. Raises ValueError: the buffer is empty."""
        if self.size == 0:
            raise ValueError("the replay buffer has nothing to sample from")
        rows = generator.integers(self.size, size=len(batch))
        for array, out in zip(self._arrays, batch.arrays, strict=True):
            np.take(array, rows, axis=0, out=out, mode="clip")  # the default mode "raise" copies the whole of `out`

    def state(self) -> PartState:
        """Return the state for a checkpoint, with the rows in their places: the same draw finds the same rows."""
        tensors = {name: array[: self.size] for name, array in zip(NAMES, self._arrays, strict=True)}
        return PartState(tensors, {"capacity": self.capacity, "next": self._next})

    def restore(self, state: PartState) -> None:
        """Take over the state of a checkpoint."""
        if state.integer("capacity") != self.capacity:
            raise ValueError(f"capacity: {state.integer('capacity')}, not {self.capacity}")
        size = len(state.tensor("reward", (None, 1), "float32"))
        at = state.integer("next")
        full = size == self.capacity
        if size > self.capacity or not (0 <= at < size if full else at == size):
            raise ValueError(f"next: {at} with {size} rows")
        for name, array in zip(NAMES, self._arrays, strict=True):
            missing = name in ADDED and name not in state.tensors
            array[:size] = 0.0 if missing else state.tensor(name, (size, array.shape[1]), "float32")
        self.size, self._next = size, at

"""Fit the networks of the rivals to recorded rollouts (`deploy/data/rival_rollouts.py`).

SECAS   min Σ_t (c_i(s'_t) − c_i(s_t) − g_i(s_t)ᵀ a_t)²            per constraint i (Dalal et al. 2018, eq. 3)
SAILR   min Σ_t BCE(σ(f(x_t)), y_t)                                 per critic, y the cost-to-go in [0, 1]
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from brakeline.errors import BadData
from brakeline.learner.networks import Adam, Network
from brakeline.learner.symmetry import SymmetryAugmentation
from brakeline.messaging.perceptrons import Perceptrons
from brakeline.messaging.task import RobotWithTask

Array = NDArray[np.float64]


@dataclass(frozen=True)
class FitConfig:
    """Settings of a fit."""

    hidden: tuple[int, ...]
    rate: float = 1e-3
    batch: int = 256
    epochs: int = 20
    held_out: float = 0.1  # share of the samples for the stated errors

    def __post_init__(self) -> None:
        if min(self.batch, self.epochs) < 1 or not self.hidden or not 0.0 < self.held_out < 1.0:
            raise ValueError(f"batch and epochs are 1 or more, held_out is between 0 and 1: {self}")


Gradient = Callable[[Tensor, NDArray[np.intp]], Tensor]  # outputs (count, batch, out) and their rows -> dL/doutputs


def fit_linear(
    observation: Array, action: Array, change: Array, how: FitConfig, seed: int
) -> tuple[Perceptrons, Array]:
    """Fit networks g_i with change_i ≈ g_i(observation)ᵀ action, one for each column of `change` (N, K).

    Returns:
        The networks; and (2, K) on held-out samples, their root mean squared errors and those of predicting no change.

    Raises:
        BadData: there are fewer samples than a batch.
    """
    seen, actions, changes = (torch.from_numpy(np.asarray(a, np.float32)) for a in (observation, action, change))

    def gradient(outputs: Tensor, rows: NDArray[np.intp]) -> Tensor:
        error = torch.einsum("kbm,bm->kb", outputs, actions[rows]) - changes[rows].T
        return error[:, :, None] * actions[rows] * (2.0 / len(rows))

    networks, apart = _fit(seen, (change.shape[1], action.shape[1]), gradient, how, seed)
    predicted = np.array([(networks(seen[t].numpy()) @ actions[t].numpy()) for t in apart])
    rest = change[apart]
    return networks, np.sqrt(np.stack([((predicted - rest) ** 2).mean(0), (rest**2).mean(0)]))


def fit_cost(
    robot: RobotWithTask, x: Array, cost: Array, count: int, how: FitConfig, seed: int
) -> tuple[Perceptrons, float]:
    """Fit `count` networks, with different initial parameters, whose sigmoid is a cost.

    The networks learn from images too (`learner/symmetry.py`).

    Args:
        x: inputs (N, i), observations or pairs of observation and action.
        cost: (N,) in [0, 1].

    Returns:
        The networks; and the mean absolute error of their mean on held-out samples.

    Raises:
        BadData: there are fewer samples than a batch.
    """
    inputs, costs = (torch.from_numpy(np.asarray(a, np.float32)) for a in (x, cost))

    def gradient(outputs: Tensor, rows: NDArray[np.intp]) -> Tensor:
        return (torch.sigmoid(outputs) - costs[rows][:, None]) / len(rows)

    networks, apart = _fit(inputs, (count, 1), gradient, how, seed, SymmetryAugmentation(robot, how.batch))
    predicted = np.array([1.0 / (1.0 + np.exp(-networks(inputs[t].numpy()).astype(float))) for t in apart])
    return networks, float(np.abs(predicted.mean((1, 2)) - cost[apart]).mean())


def _fit(
    inputs: Tensor,
    shape: tuple[int, int],
    gradient: Gradient,
    how: FitConfig,
    seed: int,
    images: SymmetryAugmentation | None = None,
) -> tuple[Perceptrons, NDArray[np.intp]]:
    """Return `shape[0]` networks with `shape[1]` outputs, and the held-out rows."""
    torch.set_num_threads(1)
    rng = np.random.default_rng(seed)
    order = rng.permutation(len(inputs))
    aside = max(1, int(how.held_out * len(inputs)))
    apart, fitted = order[:aside], order[aside:]
    if len(fitted) < how.batch:
        raise BadData(f"{len(inputs)} samples are fewer than one batch ({how.batch})")
    count, outputs = shape
    network = Network((inputs.shape[1], *how.hidden, outputs), count, how.batch)
    network.initialise(torch.Generator().manual_seed(int(rng.integers(2**31))))
    adam = Adam(network.parameters, how.rate)
    torch.set_flush_denormal(True)
    for rows in _batches(fitted, how, rng):
        drawn = inputs[rows] if images is None else torch.from_numpy(images.rows(inputs[rows].numpy()))
        predictions = network.forward(drawn[None])
        adam.step(network.parameter_gradient(gradient(predictions, rows)))
    torch.set_flush_denormal(False)
    layers = [(layer.weight.numpy().copy(), layer.bias[:, 0].numpy().copy()) for layer in network.layers]
    return Perceptrons(layers), apart


def _batches(rows: NDArray[np.intp], how: FitConfig, rng: np.random.Generator) -> Iterator[NDArray[np.intp]]:
    """Yield the whole batches of every epoch, each epoch in a random order."""
    for _ in range(how.epochs):
        order = rng.permutation(rows)
        for start in range(0, len(order) - how.batch + 1, how.batch):
            yield order[start : start + how.batch]

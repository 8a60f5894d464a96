"""Adam (Kingma and Ba 2015) on one flat vector."""

from __future__ import annotations

import math

import torch
from torch import Tensor

BETA_MEAN = 0.9
BETA_SQUARE = 0.999
EPSILON = 1e-8


class Adam:
    """p ← p − lr · m̂ / (√v̂ + ε), with m and v the running means of the gradient and of its square.

    The constructor creates the whole state (`mean`, `square`, `count`), so that a checkpoint can be copied into it.
    """

    def __init__(self, parameters: Tensor, rate: float) -> None:
        self.parameters, self.rate = parameters, rate
        self.mean = torch.zeros_like(parameters)
        self.square = torch.zeros_like(parameters)
        self.count = 0
        self._root = torch.zeros_like(parameters)

    def step(self, gradients: Tensor) -> None:
        """Update the parameters in place."""
        self.count += 1
        self.mean.lerp_(gradients, 1.0 - BETA_MEAN)
        self.square.mul_(BETA_SQUARE).addcmul_(gradients, gradients, value=1.0 - BETA_SQUARE)
        # √v̂ + ε = (√v + ε √c) / √c with c = 1 − β^count: the bias corrections need no pass over the vector.
        mean_correction = 1.0 - BETA_MEAN**self.count
        root_correction = math.sqrt(1.0 - BETA_SQUARE**self.count)
        torch.sqrt(self.square, out=self._root).add_(EPSILON * root_correction)
        self.parameters.addcdiv_(self.mean, self._root, value=-self.rate * root_correction / mean_correction)

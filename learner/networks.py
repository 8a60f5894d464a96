"""Several multilayer perceptrons of one shape, with explicit gradients.

Matrix products should take most of the time of a training step. Therefore the parameters of a network are one flat
vector (one Adam step, one Polyak step), twin critics are one batched product, and all arrays are allocated once.
Autograd is slower at these sizes; `tests/learner/test_networks.py` compares the gradients with autograd.
"""

from __future__ import annotations

import math
from itertools import pairwise

import torch
from torch import Tensor

from brakeline.learner.learner_config import Precision

BETA_MEAN = 0.9
BETA_SQUARE = 0.999
EPSILON = 1e-8
WIDE = 64  # width from which bfloat16 makes a product faster


class Dense:
    """A layer of `count` affine maps, z_i = x_i W_iᵀ + b_i.

    Shapes: x (count, batch, in), W (count, out, in), b (count, 1, out), z (count, batch, out).
    """

    def __init__(self, weight: Tensor, bias: Tensor, batch: int) -> None:
        count, outputs, inputs = weight.shape
        self.weight, self.bias = weight, bias
        self.x = torch.zeros(count, batch, inputs)
        self.z = torch.zeros(count, batch, outputs)
        self.dx = torch.zeros(count, batch, inputs)

    def forward(self, x: Tensor) -> Tensor:
        """Return z for x (count or 1, batch, in). The layer refers to x until the backward pass."""
        self.x = x.expand(self.weight.shape[0], -1, -1)
        return torch.baddbmm(self.bias, self.x, self.weight.mT, out=self.z)

    def parameter_gradient(self, dz: Tensor, weight_gradient: Tensor, bias_gradient: Tensor) -> None:
        """Write the gradients of the weight and the bias for a gradient dz of z."""
        torch.bmm(dz.mT, self.x, out=weight_gradient)
        torch.sum(dz, dim=1, keepdim=True, out=bias_gradient)

    def input_gradient(self, dz: Tensor) -> Tensor:
        """Return the gradient of x for a gradient dz of z."""
        if self.weight.shape[1] == 1:  # an outer product, for which `bmm` takes fifteen times as long
            return torch.mul(dz, self.weight, out=self.dx)
        return torch.bmm(dz, self.weight, out=self.dx)


class HalfDense(Dense):
    """A `Dense` that rounds the factors and results of its products to bfloat16. Parameters stay in float32.

    It is faster on a processor that multiplies bfloat16 (AVX512-BF16, AMX), and slower on others.
    """

    def __init__(self, weight: Tensor, bias: Tensor, batch: int) -> None:
        super().__init__(weight, bias, batch)
        self.half_weight = weight.bfloat16()
        self.half_gradient = torch.zeros_like(self.half_weight)
        self.half_x = self.x.bfloat16()
        self.half_z = self.z.bfloat16()
        self.half_dx = self.dx.bfloat16()

    def forward(self, x: Tensor) -> Tensor:
        self.half_weight.copy_(self.weight)
        self.half_x.copy_(x)
        torch.bmm(self.half_x, self.half_weight.mT, out=self.half_z)
        return torch.add(self.half_z, self.bias, out=self.z)

    def parameter_gradient(self, dz: Tensor, weight_gradient: Tensor, bias_gradient: Tensor) -> None:
        self.half_z.copy_(dz)
        torch.bmm(self.half_z.mT, self.half_x, out=self.half_gradient)
        weight_gradient.copy_(self.half_gradient)
        torch.sum(dz, dim=1, keepdim=True, out=bias_gradient)

    def input_gradient(self, dz: Tensor) -> Tensor:
        self.half_z.copy_(dz)
        torch.bmm(self.half_z, self.half_weight, out=self.half_dx)
        return self.dx.copy_(self.half_dx)


class Network:
    """`count` perceptrons of one shape: affine, ReLU, affine, …, affine."""

    def __init__(
        self,
        sizes: tuple[int, ...],
        count: int,
        batch: int,
        precision: Precision = "float32",
        parameters: Tensor | None = None,
    ) -> None:
        # sizes: (inputs, hidden…, outputs)
        self.sizes, self.count, self.batch, self.precision = sizes, count, batch, precision
        size = count * sum(o * i + o for i, o in pairwise(sizes))
        # all weights and biases as one vector
        self.parameters = torch.zeros(size) if parameters is None else parameters
        self.gradients = torch.zeros(size)
        self._gradient_views = self._views(self.gradients)
        self._stack(self._views(self.parameters))

    def _stack(self, views: list[tuple[Tensor, Tensor]]) -> None:
        self.layers: list[Dense] = []
        for weight, bias in views:
            wide = min(weight.shape[1:]) >= WIDE
            kind = HalfDense if self.precision == "bfloat16" and wide else Dense
            self.layers.append(kind(weight, bias, self.batch))

    def _views(self, flat: Tensor) -> list[tuple[Tensor, Tensor]]:
        """Return weight (count, out, in) and bias (count, 1, out) of every layer, as views of a flat vector."""
        views, start = [], 0
        for inputs, outputs in pairwise(self.sizes):
            weight = flat[start : start + self.count * outputs * inputs].view(self.count, outputs, inputs)
            start += weight.numel()
            bias = flat[start : start + self.count * outputs].view(self.count, 1, outputs)
            start += bias.numel()
            views.append((weight, bias))
        return views

    def initialise(self, generator: torch.Generator) -> None:
        """Draw the parameters uniformly in ±1/√(inputs of the layer), like torch's linear layers."""
        for layer in self.layers:
            bound = 1.0 / math.sqrt(layer.weight.shape[2])
            layer.weight.uniform_(-bound, bound, generator=generator)
            layer.bias.uniform_(-bound, bound, generator=generator)

    def first(self) -> Network:
        """Return a network that shares the parameters of the first perceptron, with its own working memory."""
        other = Network(self.sizes, 1, self.batch, self.precision)
        other._stack([(layer.weight[:1], layer.bias[:1]) for layer in self.layers])
        return other

    def forward(self, x: Tensor) -> Tensor:
        """Return the outputs (count, batch, out) for x (1 or count, batch, in), valid until the next call."""
        for layer in self.layers[:-1]:
            x = layer.forward(x).relu_()
        return self.layers[-1].forward(x)

    def parameter_gradient(self, dz: Tensor) -> Tensor:
        """Fill and return `gradients` for a gradient of the outputs."""
        for depth in range(len(self.layers) - 1, -1, -1):
            self.layers[depth].parameter_gradient(dz, *self._gradient_views[depth])
            if depth > 0:
                dz = self._through_relu(depth, dz)
        return self.gradients

    def input_gradient(self, dz: Tensor, columns: slice) -> Tensor:
        """Return the gradient (count, batch, columns) of some inputs for a gradient of the outputs."""
        for depth in range(len(self.layers) - 1, 0, -1):
            dz = self._through_relu(depth, dz)
        return torch.bmm(dz, self.layers[0].weight[:, :, columns])

    def _through_relu(self, depth: int, dz: Tensor) -> Tensor:
        """Return the gradient before the ReLU whose output is the input of layer `depth`."""
        dx = self.layers[depth].input_gradient(dz)
        active = self.layers[depth - 1].z  # after the ReLU, which worked in place
        torch.ops.aten.threshold_backward.grad_input(dx, active, 0, grad_input=dx)
        return dx


class Adam:
    """Adam (Kingma and Ba 2015) on one flat vector: p ← p − lr · m̂ / (√v̂ + ε).

    m and v are the running means of the gradient and of its square.
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

"""Multilayer perceptrons of equal shape, evaluated in NumPy without torch: the networks of the rivals' models.

x → relu(W₀ x + b₀) → … → W_L x + b_L        for each of `count` perceptrons, all with the same input x
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from brakeline.errors import BadWeights

Tensor = NDArray[np.float32]
Layer = tuple[Tensor, Tensor]  # weight (count, out, in), bias (count, out)


def check_layers(layers: Sequence[Layer], inputs: int, stack: tuple[int, ...] = ()) -> int:
    """Return the number of outputs of layers, each with a weight (*stack, out, in) and a bias (*stack, out).

    Raises:
        BadWeights: the layers do not fit each other or the inputs, or are not finite; the message names the layer.
    """
    if not layers:
        raise BadWeights("layers: there are none")
    for number, (weight, bias) in enumerate(layers):
        stacked = bias.ndim == len(stack) + 1 and bias.shape[:-1] == stack and bias.size > 0
        if not stacked or weight.shape != (*bias.shape, inputs):
            raise BadWeights(f"layers.{number}: {weight.shape} and {bias.shape} behind {inputs} inputs")
        if not (np.isfinite(weight).all() and np.isfinite(bias).all()):
            raise BadWeights(f"layers.{number}: not finite")
        inputs = bias.shape[-1]
    return inputs


class Perceptrons:
    """`count` perceptrons of equal shape. Equal inputs give equal outputs, bit for bit."""

    def __init__(self, layers: Sequence[Layer]) -> None:
        """Copy the layers. Raises BadWeights: layers do not fit each other, or are not finite."""
        self.layers = [(np.ascontiguousarray(w, np.float32), np.ascontiguousarray(b, np.float32)) for w, b in layers]
        first: tuple[int, ...] = self.layers[0][0].shape if self.layers else ()
        self.count, _, self.inputs = first if len(first) == 3 else (0, 0, 0)
        self.outputs = check_layers(self.layers, self.inputs, (self.count,))

    def __call__(self, x: NDArray[Any]) -> Tensor:
        """Return the outputs (count, outputs) for one input (inputs,)."""
        value: Tensor = np.broadcast_to(np.asarray(x, np.float32), (self.count, self.inputs))
        last = len(self.layers) - 1
        for number, (weight, bias) in enumerate(self.layers):
            value = np.matmul(weight, value[:, :, None])[:, :, 0] + bias
            if number != last:
                np.maximum(value, 0.0, out=value)
        return value

    def tensors(self, name: str) -> dict[str, Tensor]:
        """Return the parameters under their names in a file: `<name>.<layer>.weight` and `.bias`."""
        parts = {}
        for number, (weight, bias) in enumerate(self.layers):
            parts[f"{name}.{number}.weight"], parts[f"{name}.{number}.bias"] = weight, bias
        return parts

    @classmethod
    def of(cls, tensors: Mapping[str, NDArray[Any]], name: str) -> Perceptrons:
        """Return the perceptrons with a name from the tensors of a file.

        Raises:
            BadWeights: a layer is missing, has another type, or does not fit.
        """
        layers: list[Layer] = []
        while f"{name}.{len(layers)}.weight" in tensors:
            parts = [tensors.get(f"{name}.{len(layers)}.{kind}") for kind in ("weight", "bias")]
            if any(part is None or part.dtype != np.float32 for part in parts):
                raise BadWeights(f"{name}.{len(layers)}: a part is missing or not float32")
            layers.append((np.asarray(parts[0]), np.asarray(parts[1])))
        try:
            return cls(layers)
        except BadWeights as error:
            raise BadWeights(f"{name}: {error}") from error

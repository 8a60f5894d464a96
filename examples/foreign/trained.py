"""Store and load a trained policy: weights as safetensors, and their origin beside them as JSON."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any, Self

import numpy as np
import safetensors.numpy
from numpy.typing import NDArray

from brakeline import Robot
from examples.foreign.adapter import Array

Vector = NDArray[np.float32]
LARGEST = 5.0  # of a normalised observation
LEAST_SPREAD = 0.05  # so that an observation that hardly changes at first is not amplified


class TrainedPolicy:
    """ReLU layers (weight, bias) of a normalised observation, then tanh over the range of the robot's inputs."""

    def __init__(self, robot: Robot, layers: list[tuple[Vector, Vector]], mean: Vector, spread: Vector) -> None:
        """mean, spread: (n,), see `normalised`."""
        self.layers, self.mean, self.spread = layers, mean, spread
        self._center, self._half_range = (robot.high() + robot.low()) / 2.0, (robot.high() - robot.low()) / 2.0

    @classmethod
    def load(cls, path: Path, robot: Robot) -> Self:
        tensors = safetensors.numpy.load_file(path)
        count = len(tensors) // 2 - 1
        layers = [(tensors[f"layers.{k}.weight"], tensors[f"layers.{k}.bias"]) for k in range(count)]
        return cls(robot, layers, tensors["middle"], tensors["spread"])

    def save(self, path: Path, about: dict[str, Any]) -> None:
        tensors = {"middle": self.mean, "spread": self.spread}
        for k, (weight, bias) in enumerate(self.layers):
            tensors |= {f"layers.{k}.weight": weight, f"layers.{k}.bias": bias}
        safetensors.numpy.save_file(tensors, path)
        path.with_suffix(".json").write_text(json.dumps(about, indent=1) + "\n")

    def action(self, observation: Array) -> Vector:
        """Return the action in [-1, 1]."""
        value = normalised(observation, self.mean, self.spread)
        for weight, bias in self.layers[:-1]:
            value = np.maximum(weight @ value + bias, 0.0)
        weight, bias = self.layers[-1]
        return np.tanh(weight @ value + bias)

    def __call__(self, observation: Array) -> Array:
        """Return the robot's input."""
        return np.asarray(self._center + self._half_range * self.action(observation))


def normalised(observations: NDArray[Any], mean: Vector, spread: Vector) -> Vector:
    """Return observations (..., n) as the layers take them."""
    return np.clip((observations - mean) / spread, -LARGEST, LARGEST).astype(np.float32)


def mean_and_spread(observations: NDArray[Any]) -> tuple[Vector, Vector]:
    """Return the mean and the spread (n,) of observations (count, n)."""
    spread = np.maximum(observations.std(axis=0), LEAST_SPREAD)
    return observations.mean(axis=0).astype(np.float32), spread.astype(np.float32)

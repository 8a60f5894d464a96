"""A policy as it is stored: safetensors, and beside it what it came from as JSON."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any, Self

import numpy as np
import safetensors.numpy
from numpy.typing import NDArray

from brakeline.messaging.robot import Robot
from examples.foreign.adapter import Array

Vector = NDArray[np.float32]
FARTHEST = 5.0  # of a normalised observation

LEAST_SPREAD = 0.05  # an observation that hardly changed at first is not blown up


class Trained:
    """ReLU layers (weight, bias) of a normalised observation, then tanh over the range of the robot's inputs.

    middle, spread (n,): (observation - middle) / spread is what the layers see.
    """

    def __init__(self, robot: Robot, layers: list[tuple[Vector, Vector]], middle: Vector, spread: Vector) -> None:
        self.layers, self.middle, self.spread = layers, middle, spread
        self._centre, self._half = (robot.high() + robot.low()) / 2.0, (robot.high() - robot.low()) / 2.0

    @classmethod
    def load(cls, path: Path, robot: Robot) -> Self:
        tensors = safetensors.numpy.load_file(path)
        count = len(tensors) // 2 - 1
        layers = [(tensors[f"layers.{k}.weight"], tensors[f"layers.{k}.bias"]) for k in range(count)]
        return cls(robot, layers, tensors["middle"], tensors["spread"])

    def save(self, path: Path, about: dict[str, Any]) -> None:
        tensors = {"middle": self.middle, "spread": self.spread}
        for k, (weight, bias) in enumerate(self.layers):
            tensors |= {f"layers.{k}.weight": weight, f"layers.{k}.bias": bias}
        safetensors.numpy.save_file(tensors, path)
        path.with_suffix(".json").write_text(json.dumps(about, indent=1) + "\n")

    def normalised(self, observation: Array) -> Vector:
        """In [-1, 1]."""
        value = seen(observation, self.middle, self.spread)
        for weight, bias in self.layers[:-1]:
            value = np.maximum(weight @ value + bias, 0.0)
        weight, bias = self.layers[-1]
        return np.tanh(weight @ value + bias)

    def __call__(self, observation: Array) -> Array:
        """The robot's input."""
        return np.asarray(self._centre + self._half * self.normalised(observation))


def seen(observation: NDArray[Any], middle: Vector, spread: Vector) -> Vector:
    """Observations (..., n) as the layers see them."""
    return np.clip((observation - middle) / spread, -FARTHEST, FARTHEST).astype(np.float32)


def scale(observations: NDArray[Any]) -> tuple[Vector, Vector]:
    """Middle and spread of observations (count, n)."""
    spread = np.maximum(observations.std(axis=0), LEAST_SPREAD)
    return observations.mean(axis=0).astype(np.float32), spread.astype(np.float32)

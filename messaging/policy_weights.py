"""Policies as bytes on the bus and in files, and their forward pass without torch.

The format is safetensors: `layers.K.weight` (out, in) and `layers.K.bias` (out,), float32, with K from 0. The metadata
entry `policy` is JSON with the robot's name, the hash of its layout, the version and the exploration noise.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import safetensors
import safetensors.numpy
from numpy.typing import NDArray

from brakeline.errors import BadWeights
from brakeline.messaging.perceptrons import Layer, check_layers
from brakeline.messaging.robot import Array, shipped_robots
from brakeline.messaging.robot_files import REAL_TIME_SUFFIX
from brakeline.messaging.structured_text import parse_json
from brakeline.messaging.task import RobotWithTask, robot_with_task

POLICY = "policy.safetensors"  # name of the file with a trained policy
Matrix = NDArray[np.float32]
Layers = Sequence[Layer]  # weight (out, in), bias (out,)


class MLP:
    """A policy: observation → ReLU layers → tanh, scaled to the robot's bounds. Not thread-safe."""

    def __init__(self, robot: RobotWithTask, layers: Layers, version: int = 0, noise: float = 0.0) -> None:
        """Copy the layers.

        Args:
            noise: standard deviation of the exploration, as a fraction of half an action's range.

        Raises:
            BadWeights: the layers do not fit each other or the robot, or are not finite.
        """
        outputs = check_layers(layers, robot.task.observation_dim)
        if outputs != robot.action_dim:
            raise BadWeights(f"layers: {outputs} outputs, but {robot.name} has {robot.action_dim} inputs")
        self.robot, self.version, self.noise = robot, version, noise
        self.layers = [(np.array(weight, np.float32), np.array(bias, np.float32)) for weight, bias in layers]
        self._input = np.zeros(robot.task.observation_dim, np.float32)
        self._outputs = [np.zeros_like(bias) for _, bias in self.layers]
        self._low, self._high = robot.low(), robot.high()
        self._centre, self._half = (self._high + self._low) / 2.0, (self._high - self._low) / 2.0

    @classmethod
    def untrained(cls, robot: RobotWithTask, seed: int, hidden: tuple[int, ...] = (256, 256)) -> MLP:
        """Return a policy with parameters drawn uniformly in ±1/√(inputs of the layer), like a new learner's."""
        generator = np.random.default_rng(seed)
        layers = []
        for inputs, outputs in pairwise((robot.task.observation_dim, *hidden, robot.action_dim)):
            bound = 1.0 / np.sqrt(inputs)
            draw = generator.uniform(-bound, bound, (outputs, inputs + 1)).astype(np.float32)
            layers.append((draw[:, :inputs], draw[:, inputs]))
        return cls(robot, layers)

    @property
    def sizes(self) -> tuple[int, ...]:
        """Number of inputs, and of outputs of each layer."""
        return (self.robot.task.observation_dim, *(len(bias) for _, bias in self.layers))

    def __call__(self, observation: NDArray[Any]) -> Array:
        """Return the action (m,) in the robot's units."""
        return self._centre + self._half * self.normalised(observation)

    def explore(self, observation: NDArray[Any], generator: np.random.Generator) -> Array:
        """Return the action with Gaussian noise, clipped to the bounds."""
        draw = generator.standard_normal(self.robot.action_dim)
        action = self._centre + self._half * (self.normalised(observation) + self.noise * draw)
        return np.clip(action, self._low, self._high)

    def normalised(self, observation: NDArray[Any]) -> Matrix:
        """Return the action in [−1, 1], valid until the next call."""
        value = self._input
        value[:] = observation
        for (weight, bias), outputs in zip(self.layers, self._outputs, strict=True):
            if value is not self._input:
                np.maximum(value, 0.0, out=value)
            np.dot(weight, value, out=outputs)
            value = np.add(outputs, bias, out=outputs)
        return np.tanh(value, out=value)

    def of_many(self, observations: NDArray[Any], noise: Array | float = 0.0) -> Array:
        """Return the actions (B, m) for observations (B, o), clipped to the bounds.

        noise (B, m): added to the normalised actions, such as `noise` times normal numbers.
        """
        value = np.asarray(observations, np.float32)
        for depth, (weight, bias) in enumerate(self.layers):
            value = (np.maximum(value, 0.0) if depth else value) @ weight.T + bias
        return np.clip(self._centre + self._half * (np.tanh(value) + noise), self._low, self._high)

    def encode(self) -> bytes:
        """Return the bytes of the policy's file."""
        return encode(self.robot, self.layers, self.version, self.noise)

    def save(self, path: Path) -> None:
        """Write the policy to a file."""
        path.write_bytes(self.encode())

    @classmethod
    def load(cls, path: Path, robot: RobotWithTask | None = None) -> MLP:
        """Read a policy from a file. Raises OSError, or BadWeights as `decode`."""
        return decode(path.read_bytes(), robot)


def encode(robot: RobotWithTask, layers: Layers, version: int, noise: float = 0.0) -> bytes:
    """Return the bytes of a policy's file, which depend on nothing but the arguments."""
    tensors = {}
    for number, (weight, bias) in enumerate(layers):
        tensors[f"layers.{number}.weight"] = np.ascontiguousarray(weight, np.float32)
        tensors[f"layers.{number}.bias"] = np.ascontiguousarray(bias, np.float32)
    about = {"robot": robot.name, "layout": robot.learning_layout(), "version": version, "noise": noise}
    # One entry: safetensors does not keep the order of several.
    return safetensors.numpy.save(tensors, {"policy": json.dumps(about, sort_keys=True)})


def decode(data: bytes, robot: RobotWithTask | None = None) -> MLP:
    """Return the policy in the bytes of a file.

    Args:
        robot: the robot of the policy. None: the shipped robot that the file names.

    Raises:
        BadWeights: the bytes are not a policy, or a policy of another robot.
    """
    try:
        read: Any = safetensors.deserialize  # Any: it comes without types
        entries = dict(read(data))
        header = parse_json(data[8 : 8 + int.from_bytes(data[:8], "little")])
        about = parse_json(header["__metadata__"]["policy"])
    except (safetensors.SafetensorError, ValueError, KeyError, TypeError) as error:
        raise BadWeights(f"not a policy file: {error}") from error
    robot = _robot(about, robot)
    version, noise = about.get("version"), about.get("noise")
    if type(version) is not int or not 0 <= version < 2**32:
        raise BadWeights(f"version: {version!r}")
    if type(noise) not in (int, float) or not 0.0 <= noise < np.inf:
        raise BadWeights(f"noise: {noise!r}")
    count = len(entries) // 2
    try:
        layers = [
            (_array(entries, f"layers.{number}.weight"), _array(entries, f"layers.{number}.bias"))
            for number in range(count)
        ]
    except KeyError as error:
        raise BadWeights(f"{error.args[0]}: missing") from error
    if len(entries) != 2 * count:
        raise BadWeights(f"{len(entries)} arrays where layers have two each")
    return MLP(robot, layers, version, float(noise))


def _robot(about: Any, robot: RobotWithTask | None) -> RobotWithTask:
    if not isinstance(about, dict) or not isinstance(about.get("robot"), str):
        raise BadWeights("robot: missing")
    if robot is None:
        if about["robot"].removesuffix(REAL_TIME_SUFFIX) not in shipped_robots():  # an untrusted name is never a path
            raise BadWeights(f"robot: unknown, {about['robot']!r}")
        robot = robot_with_task(about["robot"])
    if about["robot"] != robot.name:
        raise BadWeights(f"robot: {about['robot']!r}, not {robot.name!r}")
    if not robot.accepts_learning_layout(about.get("layout")):
        raise BadWeights(f"layout: {about.get('layout')!r}, but {robot.name} has {robot.learning_layout()!r}")
    return robot


def _array(entries: dict[str, Any], name: str) -> Matrix:
    entry = entries[name]
    if entry["dtype"] != "F32":
        raise BadWeights(f"{name}: {entry['dtype']}, not F32")
    array: Matrix = np.frombuffer(entry["data"], np.float32).reshape(entry["shape"])
    return array

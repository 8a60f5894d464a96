"""A rival's model of a robot: trained networks and settings in one file, with a hash as its version.

The file is safetensors. Its metadata entry `pretrained` holds, as JSON, the robot, the hash of its layout, the method,
the settings, notes on the training, and the version. `Pretrained.decode` checks all of it.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from brakeline.errors import BadModel
from brakeline.messaging.atomic_files import write_atomically
from brakeline.messaging.perceptrons import Perceptrons
from brakeline.messaging.ray_directions import LidarRays
from brakeline.messaging.robot import Robot, robot_named
from brakeline.safety.model.model_set import robot_in
from brakeline.safety.model.tensor_file import pack, unpack

ENTRY = "pretrained"
RAYS = "rays"  # the tensor with the directions
NOT_PRETRAINED = {"samples": "0", "collisions": "0", "seconds": "0", "error": "nothing was fitted"}  # notes


@dataclass(frozen=True)
class Pretrained:
    """A rival's model."""

    robot: Robot  # that the model is for
    method: str  # that uses the model
    networks: Mapping[str, Perceptrons]  # by name
    settings: Mapping[str, float]  # the numbers that a decision depends on
    about: dict[str, str] = field(default_factory=dict)  # notes on the training
    # of the lidar whose ranges come first in an observation; None if the method does not read them
    rays: LidarRays | None = None

    @property
    def version(self) -> str:
        """The hash of everything that decisions depend on."""
        text = json.dumps([self.robot.layout(), self.method, sorted(self.settings.items())])
        digest = hashlib.sha256(text.encode())
        for name, tensor in sorted(self._tensors().items()):
            digest.update(f"{name}{tensor.shape}".encode() + tensor.tobytes())
        return digest.hexdigest()[:12]

    def _tensors(self) -> dict[str, Any]:
        tensors = {key: t for name, network in self.networks.items() for key, t in network.tensors(name).items()}
        return tensors if self.rays is None else tensors | {RAYS: self.rays.directions}

    def encode(self) -> bytes:
        about: dict[str, Any] = {
            "robot": self.robot.name,
            "layout": self.robot.layout(),
            "method": self.method,
            "settings": dict(self.settings),
            "networks": sorted(self.networks),
            "about": self.about,
            "version": self.version,
            "description": json.dumps(self.robot.description),  # as text, because the order of its names counts
        }
        if self.rays is not None:
            about["range"] = self.rays.range
        return pack(self._tensors(), ENTRY, about)

    def save(self, path: Path) -> None:
        write_atomically(path, self.encode())

    @staticmethod
    def decode(payload: bytes) -> Pretrained:
        """Return the model in the bytes of a file. Raises BadModel if they hold none, or one for another layout."""
        try:
            tensors, about = unpack(payload, ENTRY)
            robot = robot_in(about) if "description" in about else robot_named(str(about["robot"]))  # older files
            networks = {str(name): Perceptrons.of(tensors, name) for name in about["networks"]}
            settings = {str(name): float(value) for name, value in about["settings"].items()}
            rays = _rays(tensors, about)
            model = Pretrained(robot, str(about["method"]), networks, settings, dict(about["about"]), rays)
        except Exception as error:  # whatever a hostile file makes a parser raise
            raise BadModel(f"no pretrained model: {error!r}") from error
        if not robot.accepts_layout(about.get("layout")):
            raise BadModel(f"the model is for another layout of {robot.name}: pretrain it again")
        if not np.isfinite(list(settings.values())).all():
            raise BadModel("the model's settings hold NaN or infinity")
        if model.version != about.get("version"):
            raise BadModel("the model's content is not what its version says")
        return model


def _rays(tensors: Mapping[str, Any], about: Mapping[str, Any]) -> LidarRays | None:
    """Return the rays that the file holds, or None. Raises ValueError if they are not unit vectors with a range."""
    if RAYS not in tensors:
        return None
    directions, reach = tensors[RAYS], float(about["range"])
    unit = directions.ndim == 2 and directions.dtype == np.float64 and len(directions) > 0
    if not unit or not np.allclose(np.linalg.norm(directions, axis=1), 1.0) or not 0.0 < reach < np.inf:
        raise ValueError("the rays are not unit vectors with a finite range")
    return LidarRays(directions, reach)

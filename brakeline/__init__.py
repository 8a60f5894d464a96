"""Brakeline's public names: the filter in front of your own policy and robot, in process or as a service.

with SafetyClient.open("tcp/127.0.0.1:7447", "ground") as safety:      # ask a running service
    answer = safety.decide(state, action, [Obstacle("cylinder", (0.4, 0.0), (0.1,))])

env = SafetyWrapper(env, Filter(ModelSet.load(path)))                  # in process, for any RL library

Names are imported when they are first used, so that an asker needs no simulator and no solver.
"""

from __future__ import annotations

import importlib
from importlib.metadata import PackageNotFoundError, version
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from messaging.bus import BusError, BusSettings, Late, NoReply, Refused, Unreachable
    from messaging.descriptions import BadDescription
    from messaging.motion import Motion
    from messaging.range_images import RangeImage
    from messaging.robots import Disc, Limit, Robot, UnknownRobot, robot_named
    from messaging.scans import BadScan, Scan
    from messaging.shapes import BadShape, Obstacle, Shapes
    from messaging.tasks import RobotWithTask, Task, robot_with_task
    from safety.asker import Answer, Asker
    from safety.certificates import CertificateError
    from safety.client import SafetyClient, SafetyError
    from safety.commitment import Commitment, Prediction
    from safety.dataset import BadData, Dataset, Trajectory
    from safety.filter import Filter
    from safety.fitting import make
    from safety.fleet_client import FleetClient
    from safety.gym import SafetyWrapper
    from safety.image_memory import filled, memory_of
    from safety.inprocess import InProcess
    from safety.model_set import BadModel, ModelSet, Recipe
    from safety.request import BadRequest, Decision, Request
    from safety.statement import Statement, state

PLACES = {
    "messaging.bus": ("BusError", "BusSettings", "Late", "NoReply", "Refused", "Unreachable"),
    "messaging.descriptions": ("BadDescription",),
    "messaging.motion": ("Motion",),
    "messaging.range_images": ("RangeImage",),
    "messaging.robots": ("Disc", "Limit", "Robot", "UnknownRobot", "robot_named"),
    "messaging.scans": ("BadScan", "Scan"),
    "messaging.shapes": ("BadShape", "Obstacle", "Shapes"),
    "messaging.tasks": ("RobotWithTask", "Task", "robot_with_task"),
    "safety.certificates": ("CertificateError",),
    "safety.asker": ("Answer", "Asker"),
    "safety.client": ("SafetyClient", "SafetyError"),
    "safety.commitment": ("Commitment", "Prediction"),
    "safety.dataset": ("BadData", "Dataset", "Trajectory"),
    "safety.filter": ("Filter",),
    "safety.fitting": ("make",),
    "safety.fleet_client": ("FleetClient",),
    "safety.gym": ("SafetyWrapper",),
    "safety.image_memory": ("filled", "memory_of"),
    "safety.inprocess": ("InProcess",),
    "safety.model_set": ("BadModel", "ModelSet", "Recipe"),
    "safety.request": ("BadRequest", "Decision", "Request"),
    "safety.statement": ("Statement", "state"),
}
_PLACE_OF = {name: module for module, names in PLACES.items() for name in names}

__all__ = [
    "Answer",
    "Asker",
    "BadData",
    "BadDescription",
    "BadModel",
    "BadRequest",
    "BadScan",
    "BadShape",
    "BusError",
    "BusSettings",
    "CertificateError",
    "Commitment",
    "Dataset",
    "Decision",
    "Disc",
    "Filter",
    "FleetClient",
    "InProcess",
    "Late",
    "Limit",
    "ModelSet",
    "Motion",
    "NoReply",
    "Obstacle",
    "Prediction",
    "RangeImage",
    "Recipe",
    "Refused",
    "Request",
    "Robot",
    "RobotWithTask",
    "SafetyClient",
    "SafetyError",
    "SafetyWrapper",
    "Scan",
    "Shapes",
    "Statement",
    "Task",
    "Trajectory",
    "UnknownRobot",
    "Unreachable",
    "__version__",
    "filled",
    "make",
    "memory_of",
    "robot_named",
    "robot_with_task",
    "state",
]


def __getattr__(name: str) -> Any:
    if name == "__version__":
        try:
            return version("brakeline")
        except PackageNotFoundError:  # a checkout that nobody installed
            return "0+unknown"
    if name not in _PLACE_OF:
        raise AttributeError(f"brakeline has no {name!r}; it has: {', '.join(__all__)}")
    return getattr(importlib.import_module(_PLACE_OF[name]), name)


def __dir__() -> list[str]:
    return __all__

"""Brakeline's public names: the filter in front of your own policy and robot, in process or as a service.

with SafetyClient.open("tcp/127.0.0.1:7447", "ground") as safety:      # ask a running service
    answer = safety.decide(state, action, [Obstacle("cylinder", (0.4, 0.0), (0.1,))])

env = SafetyWrapper(env, Filter.load("ground"))                         # in process, for any RL library

A name is imported at its first use, so that a client of the service loads no simulator and no solver.
"""

from __future__ import annotations

import importlib
import sys
from importlib.metadata import PackageNotFoundError, version
from typing import TYPE_CHECKING, Any

from brakeline.errors import (
    BadData,
    BadDescription,
    BadModel,
    BadRequest,
    BadScan,
    BadShape,
    BusError,
    ErrorBoundError,
    Late,
    NoReply,
    Refused,
    SafetyError,
    UnknownRobot,
    Unreachable,
)

if TYPE_CHECKING:
    from brakeline.deploy.data.certification import certify
    from brakeline.deploy.data.environment_episodes import collect
    from brakeline.deploy.run.recorded_client import RecordedClient
    from brakeline.messaging.bus import BusSettings
    from brakeline.messaging.obstacle import Obstacle, Shapes
    from brakeline.messaging.obstacle_motion import Motion
    from brakeline.messaging.range_image import RangeImage
    from brakeline.messaging.robot import Disc, Limit, Robot, robot_named
    from brakeline.messaging.robot_description import robot_from_description
    from brakeline.messaging.scan import Scan
    from brakeline.messaging.task import RobotWithTask, Task, robot_with_task
    from brakeline.safety.action_mapping import ActionMapping, normalised
    from brakeline.safety.filter.backup_plan import BackupPlan, Prediction
    from brakeline.safety.filter.batch.decision_arrays import DecisionArrays
    from brakeline.safety.filter.batch.obstacle_arrays import ObstacleArrays
    from brakeline.safety.filter.batch.request_arrays import PastArrays, PredictionArrays, RequestArrays
    from brakeline.safety.filter.filter import Filter
    from brakeline.safety.filter.request import Decision, Request
    from brakeline.safety.gym import SafetyWrapper
    from brakeline.safety.model.dataset import Dataset, Trajectory
    from brakeline.safety.model.fitting import fit_model_set
    from brakeline.safety.model.model_set import ModelConfig, ModelSet
    from brakeline.safety.model.validation import ValidationReport, validate
    from brakeline.safety.perception.image_memory import filled, memory_of
    from brakeline.safety.rivals.own_code import OwnFilter
    from brakeline.safety.service.client import SafetyClient
    from brakeline.safety.service.filter_client import Answer, FilterClient
    from brakeline.safety.service.fleet_client import FleetClient
    from brakeline.safety.service.in_process import InProcess

# The modules of the names that are imported at their first use; the same as above, for the interpreter.
PLACES = {
    "brakeline.deploy.data.certification": ("certify",),
    "brakeline.deploy.data.environment_episodes": ("collect",),
    "brakeline.deploy.run.recorded_client": ("RecordedClient",),
    "brakeline.messaging.bus": ("BusSettings",),
    "brakeline.messaging.obstacle": ("Obstacle", "Shapes"),
    "brakeline.messaging.obstacle_motion": ("Motion",),
    "brakeline.messaging.range_image": ("RangeImage",),
    "brakeline.messaging.robot": ("Disc", "Limit", "Robot", "robot_named"),
    "brakeline.messaging.robot_description": ("robot_from_description",),
    "brakeline.messaging.scan": ("Scan",),
    "brakeline.messaging.task": ("RobotWithTask", "Task", "robot_with_task"),
    "brakeline.safety.action_mapping": ("ActionMapping", "normalised"),
    "brakeline.safety.filter.backup_plan": ("BackupPlan", "Prediction"),
    "brakeline.safety.filter.batch.decision_arrays": ("DecisionArrays",),
    "brakeline.safety.filter.batch.obstacle_arrays": ("ObstacleArrays",),
    "brakeline.safety.filter.batch.request_arrays": ("PastArrays", "PredictionArrays", "RequestArrays"),
    "brakeline.safety.filter.filter": ("Filter",),
    "brakeline.safety.filter.request": ("Decision", "Request"),
    "brakeline.safety.gym": ("SafetyWrapper",),
    "brakeline.safety.model.dataset": ("Dataset", "Trajectory"),
    "brakeline.safety.model.fitting": ("fit_model_set",),
    "brakeline.safety.model.model_set": ("ModelConfig", "ModelSet"),
    "brakeline.safety.model.validation": ("ValidationReport", "validate"),
    "brakeline.safety.perception.image_memory": ("filled", "memory_of"),
    "brakeline.safety.rivals.own_code": ("OwnFilter",),
    "brakeline.safety.service.client": ("SafetyClient",),
    "brakeline.safety.service.filter_client": ("Answer", "FilterClient"),
    "brakeline.safety.service.fleet_client": ("FleetClient",),
    "brakeline.safety.service.in_process": ("InProcess",),
}
_PLACE_OF = {name: module for module, names in PLACES.items() for name in names}

# fmt: off
__all__ = [
    "ActionMapping", "Answer", "BackupPlan", "BadData", "BadDescription", "BadModel", "BadRequest", "BadScan",
    "BadShape", "BusError", "BusSettings", "Dataset", "Decision", "DecisionArrays", "Disc", "ErrorBoundError",
    "Filter", "FilterClient", "FleetClient", "InProcess", "Late", "Limit", "ModelConfig", "ModelSet", "Motion",
    "NoReply", "Obstacle", "ObstacleArrays", "OwnFilter", "PastArrays", "Prediction", "PredictionArrays",
    "RangeImage", "RecordedClient", "Refused", "Request", "RequestArrays", "Robot", "RobotWithTask", "SafetyClient",
    "SafetyError", "SafetyWrapper", "Scan", "Shapes", "Task", "Trajectory", "UnknownRobot", "Unreachable",
    "ValidationReport", "__version__", "certify", "collect", "filled", "fit_model_set", "memory_of", "normalised",
    "robot_from_description", "robot_named", "robot_with_task", "validate",
]
# fmt: on


def __getattr__(name: str) -> Any:
    if name == "__version__":
        try:
            return version("brakeline")
        except PackageNotFoundError:  # a checkout that nobody installed
            return "0+unknown"
    if name not in _PLACE_OF:
        raise AttributeError(f"brakeline has no {name!r}; it has: {', '.join(__all__)}")
    try:
        return getattr(importlib.import_module(_PLACE_OF[name]), name)
    except ModuleNotFoundError as error:
        from brakeline.extras import missing_extra

        if (missing := missing_extra(error)) is not None:
            raise missing from error
        raise


def __dir__() -> list[str]:
    return __all__


if "gymnasium" in sys.modules:  # otherwise import `brakeline.envs`: a client needs no Gymnasium
    from brakeline import envs as _envs  # noqa: F401

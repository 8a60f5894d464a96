"""Paths of data sets and model sets. Every process of a run imports this module: keep its imports light.

data/<robot>/record.safetensors                     the recorded trajectories
data/<robot>/<certificate>-<mode>.safetensors       the model set in use, made from them
data/<robot>/<rival>.safetensors                    the rival's networks, pre-trained (<rival>+<task> for another task)
data/<robot>/models/<version>.safetensors           every version a service has used
"""

from __future__ import annotations

import os
from dataclasses import replace
from pathlib import Path

from brakeline.messaging.robot import TASK_SEPARATOR, Robot
from brakeline.messaging.task import RobotWithTask
from brakeline.safety.model.model_config import AUTO, DDPC, DIRECT, ONE_STEP, ModelConfig


def data_root() -> Path:
    """Return `$BRAKELINE_DATA`, or `data` in the working directory if it is not set."""
    return Path(os.environ.get("BRAKELINE_DATA", "data"))


def record_path(robot: Robot) -> Path:
    """Return the path of the robot's data set in use."""
    return data_root() / robot.name / "record.safetensors"


def model_path(robot: Robot, model_config: ModelConfig) -> Path:
    """Return the path of the model set in use with this error bound and mode.

    Mode `AUTO` gives the newer one of the modes one-step and direct, and direct if there is none.
    """
    if model_config.mode != AUTO:
        return data_root() / robot.name / f"{model_config.certificate}-{model_config.mode}.safetensors"
    direct, one_step = (model_path(robot, replace(model_config, mode=mode)) for mode in (DIRECT, ONE_STEP))
    if not one_step.exists() or (direct.exists() and direct.stat().st_mtime > one_step.stat().st_mtime):
        return direct
    return one_step


def method_path(robot: Robot, method: str, model_config: ModelConfig) -> Path:
    """Return the path of the model that the safety service loads for a method."""
    if method == DDPC:
        return model_path(robot, model_config)
    other = robot.task.name.partition(TASK_SEPARATOR)[2] if isinstance(robot, RobotWithTask) else ""
    return data_root() / robot.name / f"{method}{TASK_SEPARATOR if other else ''}{other}.safetensors"

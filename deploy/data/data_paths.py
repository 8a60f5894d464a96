"""Paths of data sets and model sets. Every process of a run imports this module: keep its imports light.

data/<robot>/record.safetensors                     the recorded trajectories
data/<robot>/<certificate>-<mode>.safetensors       the model set in use, made from them
data/<robot>/<certificate>.in_use                    the mode that was put to use last, for mode auto
data/<robot>/<rival>.safetensors                    the rival's networks, pre-trained (<rival>+<task> for another task)
data/<robot>/models/<version>.safetensors           every version a service has used
"""

from __future__ import annotations

import os
from dataclasses import replace
from pathlib import Path

from brakeline.errors import BadModel
from brakeline.messaging.atomic_files import write_atomically
from brakeline.messaging.robot import Robot
from brakeline.messaging.robot_files import TASK_SEPARATOR
from brakeline.messaging.task import RobotWithTask
from brakeline.safety.model.model_config import AUTO, DDPC, DIRECT, ONE_STEP, ModelConfig


def data_root() -> Path:
    """Return `$BRAKELINE_DATA`, or `data` in the working directory if it is not set or empty."""
    return Path(os.environ.get("BRAKELINE_DATA") or "data")


def record_path(robot: Robot) -> Path:
    """Return the path of the robot's data set in use."""
    return data_root() / robot.name / "record.safetensors"


def model_path(robot: Robot, model_config: ModelConfig) -> Path:
    """Return the path of the model set in use with this error bound and mode.

    Mode `AUTO` gives the mode that was put to use last (`note_mode`), whatever the times of the files are. If none was,
    it gives the mode of which there is a model set, and direct if there are both or none.

    Raises:
        BadModel: the note is damaged, or the model set of the noted mode is gone, and there is one of the other mode.
    """
    if model_config.mode != AUTO:
        return data_root() / robot.name / f"{model_config.certificate}-{model_config.mode}.safetensors"
    paths = {mode: model_path(robot, replace(model_config, mode=mode)) for mode in (DIRECT, ONE_STEP)}
    noted, existing = _noted_mode(robot, model_config), [mode for mode in paths if paths[mode].exists()]
    if noted and existing and noted not in existing:
        raise BadModel(
            f"the model set in use, {paths[noted]}, is gone: certify again with --use. To use the one of mode "
            f"{existing[0]} instead, delete {_note_path(robot, model_config)}"
        )
    return paths[noted or next(iter(existing), DIRECT)] if existing else paths[DIRECT]


def note_mode(robot: Robot, model_config: ModelConfig) -> None:
    """Note that the model set of this mode was put to use, for mode `AUTO`. Other modes do not take part."""
    if model_config.mode in (DIRECT, ONE_STEP):
        write_atomically(_note_path(robot, model_config), model_config.mode.encode())


def _note_path(robot: Robot, model_config: ModelConfig) -> Path:
    return data_root() / robot.name / f"{model_config.certificate}.in_use"


def _noted_mode(robot: Robot, model_config: ModelConfig) -> str:
    """Return the mode that was put to use last; empty if none was. Raises BadModel."""
    path = _note_path(robot, model_config)
    try:
        mode = path.read_bytes().decode(errors="replace").strip()
    except FileNotFoundError:
        return ""
    except OSError as error:
        raise BadModel(f"{path}: {error}") from error
    if mode not in (DIRECT, ONE_STEP):
        raise BadModel(f"{path}: no mode is called {mode!r:.40}: certify again with --use, or give --mode")
    return mode


def method_path(robot: Robot, method: str, model_config: ModelConfig) -> Path:
    """Return the path of the model that the safety service loads for a method."""
    if method == DDPC:
        return model_path(robot, model_config)
    other = robot.task.name.partition(TASK_SEPARATOR)[2] if isinstance(robot, RobotWithTask) else ""
    return data_root() / robot.name / f"{method}{TASK_SEPARATOR if other else ''}{other}.safetensors"

"""Keep the models of a run in its folder, so that a resumed run goes on with them.

The data folder holds the models in use, which `certify --use` replaces at any time. A run begins with copies of them,
and its safety service adds each version that it is sent.
"""

from __future__ import annotations

import logging
import shutil
from dataclasses import replace
from pathlib import Path

from brakeline.deploy.data.data_paths import method_path
from brakeline.deploy.data.model_store import method_for
from brakeline.deploy.progress import console
from brakeline.deploy.run.run_config import RunConfig
from brakeline.errors import BadModel
from brakeline.messaging.acceleration_age import acceleration_age_in
from brakeline.messaging.atomic_files import write_atomically
from brakeline.messaging.robot import Robot
from brakeline.messaging.task import robot_maybe_with_task
from brakeline.safety.methods import IN_USE, Model, archive_path, load
from brakeline.safety.model.model_config import AUTO
from brakeline.safety.model.model_set import ModelSet
from brakeline.safety.model.stated_bound import check_bound
from brakeline.safety.service.signature import SignedModel, TrustedSigners, seal_of

log = logging.getLogger("brakeline.launcher")


def models_of_new_run(config: RunConfig, folder: Path) -> tuple[RunConfig, list[Model]]:
    """Copy the models in use to the folder of a new run; build those that are missing.

    Returns:
        The configuration, with the mode of the model sets in place of `AUTO` if it is the same for all; the models.

    Raises:
        BadModel: a vehicle that is not simulated here has no model set.
        TooLoose: the stated bound of a model set is above the accepted one.
    """
    models = []
    simulated = not config.flights or config.autopilot is not None
    for name in config.robots:
        robot = robot_maybe_with_task(name)
        model = method_for(robot, config.method, config.model_config, config.accept_bound, build=simulated)
        source = method_path(robot, config.method, config.model_config)
        archived = archive_path(folder, robot.name, model.version)
        archived.parent.mkdir(parents=True, exist_ok=True)
        for path in (source, seal_of(source)):
            if path.exists():
                shutil.copyfile(path, archived.with_suffix(path.suffix))
        write_atomically(archived.with_name(IN_USE), model.version.encode())
        models.append(model)
        config = _with_acceleration_age(config, model)
    modes = {model.model_config.mode for model in models if isinstance(model, ModelSet)}
    if config.model_config.mode == AUTO and len(modes) == 1:
        config = replace(config, model_config=replace(config.model_config, mode=modes.pop()))
    return config, models


def _with_acceleration_age(config: RunConfig, model: Model) -> RunConfig:
    """Let the vehicles of a flight report accelerations of the age with which the model was recorded.

    Raises:
        BadModel: another age was asked for.
    """
    age = acceleration_age_in(model.about)
    for flight in config.flights:
        if flight.acceleration_age not in (0.0, age):
            raise BadModel(
                f"the model set in use was recorded with the horizontal acceleration of {age:g} s ago, not of "
                f"{flight.acceleration_age:g} s ago: leave out --acceleration-age"
            )
    return replace(config, flights=tuple(replace(flight, acceleration_age=age) for flight in config.flights))


def models_of_resumed_run(config: RunConfig, folder: Path) -> list[Model]:
    """Return the models that a run used last, and say if others are in use meanwhile.

    Raises:
        BadModel: a model is missing in the run's folder, or damaged.
        TooLoose: the stated bound of a model set is above the accepted one.
    """
    models = []
    for name in config.robots:
        robot = robot_maybe_with_task(name)
        archived = newest_model(folder, robot.name, None)
        in_use = method_path(robot, config.method, config.model_config)
        if archived is None:
            missing = archive_path(folder, robot.name, "*")
            raise BadModel(f"{folder} can't be resumed: no model of {robot.name} in {missing.parent}. Start a new run")
        model = load(archived)
        check_bound(model, robot, config.accept_bound)
        if not in_use.exists() or load(in_use).version != model.version:
            console.print(
                f"{robot.name}: the run goes on with its own model {model.version}, in {archived.parent}. {in_use} is "
                "another one: start a new run to use it.",
                markup=False,
            )
        models.append(model)
    return models


def model_in_run(config: RunConfig, folder: Path, robot: Robot, trust: TrustedSigners | None = None) -> Path:
    """Return the model that a run used last; the one in use in the data folder if the run's folder has none.

    trust: see `newest_model`.
    """
    return newest_model(folder, robot.name, trust) or method_path(robot, config.method, config.model_config)


def newest_model(folder: Path, robot: str, trust: TrustedSigners | None) -> Path | None:
    """Return the model that a restarted service of this run uses again.

    Args:
        trust: the accepted signers, on a bus with keys. The model that they signed last is the newest. Without keys,
            the archive notes which model was put to use last. The times of the files never count.

    Returns:
        The file; None if there is none.
    """
    versions = archive_path(folder, robot, "*")
    paths = sorted(versions.parent.glob(versions.name))
    if trust is None:
        return _noted_model(versions.parent, paths)
    numbered = []
    for path in paths:
        try:
            numbered.append((trust.number(SignedModel.load(path)), path))
        except BadModel as error:
            log.warning("model not used: %s", error)
    for _, path in sorted(numbered, reverse=True):
        try:
            trust.load_model(path)
        except BadModel as error:
            log.warning("model not used: %s", error)
            continue
        return path
    return None


def signed_last(in_use: Path, archive: Path, robot: str, trust: TrustedSigners, mode: str) -> Path:
    """Return the model with which a restarted service goes on: that in use, or a later one that it was sent.

    Args:
        in_use: the file of the model in use.
        archive: the service's, with the versions that it was sent.
        mode: of the model sets that the service may use; `AUTO`: any.

    Raises:
        BadModel: the model in use is missing, damaged or not signed.
    """
    chosen, newest = trust.load_model(in_use), newest_model(archive, robot, trust)
    if newest is None or trust.number(SignedModel.load(newest)) <= trust.number(SignedModel.load(in_use)):
        return in_use
    later = trust.load_model(newest)
    if not (isinstance(later, ModelSet) and isinstance(chosen, ModelSet) and later.robot.name == robot):
        return in_use
    return newest if mode in (AUTO, later.model_config.mode) else in_use


def _noted_model(archive: Path, paths: list[Path]) -> Path | None:
    """Return the model that an archive of these models notes as put to use last, or its only one, if it is whole."""
    try:
        path = paths[0] if len(paths) == 1 else archive / f"{(archive / IN_USE).read_text().strip()}.safetensors"
        if path not in paths:
            raise BadModel(f"{archive / IN_USE} names no model that is there")
        load(path)
    except (OSError, ValueError) as error:
        if paths:
            log.warning("model not used: %s", error)
        return None
    return path

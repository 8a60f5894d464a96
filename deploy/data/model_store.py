"""Load the models that a robot uses, build those that are missing, and put a model set to use.

Simulators, PyTorch and SciPy's statistics are imported only where a model is built. A service that finds its model
saves seconds and hundreds of megabytes.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, TypeVar

from brakeline.deploy.data.build_lock import folder_lock
from brakeline.deploy.data.data_paths import method_path, model_path, note_mode, record_path
from brakeline.deploy.data.recording_origin import outdated
from brakeline.deploy.progress import console, under_way
from brakeline.errors import BadData, BadModel
from brakeline.messaging.atomic_files import write_atomically
from brakeline.messaging.robot import Robot
from brakeline.messaging.stated_share import percent
from brakeline.messaging.task import RobotWithTask, needs_task
from brakeline.messaging.task_code import is_own_code
from brakeline.safety.methods import METHODS, Model
from brakeline.safety.model.model_config import AUTO, DDPC, DIRECT, ONE_STEP
from brakeline.safety.model.model_set import ModelConfig, ModelSet
from brakeline.safety.model.stated_bound import accepted_bound, check_bound
from brakeline.safety.rivals.own_code import OwnCode
from brakeline.safety.rivals.pretrained import NOT_PRETRAINED, Pretrained

if TYPE_CHECKING:
    from brakeline.deploy.data.rival_pretraining import RivalConfig
    from brakeline.safety.model.dataset import Dataset

M = TypeVar("M")


def model_for(
    robot: Robot, model_config: ModelConfig, accept_bound: float | None = None, build: bool = True
) -> ModelSet:
    """Load the model set in use. If the file is missing or of another layout, record data and certify first.

    In mode auto, a robot without a recording uses the model set that comes with Brakeline, if there is one.

    Args:
        robot: the robot, with its description of today.
        accept_bound: largest accepted bound on the share of plans that leave their tubes, in [0, 1]. Defaults to the
            limit in the robot's description.
        build: False for a vehicle that is not simulated here. Data from the simulator say nothing about it, so
            there must be a model set.

    Raises:
        BadModel: there is no model set for this description, and `build` is False.
        TooLoose: the model set states a larger bound, or none.
        ValueError: `accept_bound` is not in [0, 1].
    """
    accepted_bound(robot, accept_bound)
    path = model_path(robot, model_config)
    if build:
        make = partial(_build_model_set, path, robot, model_config)
        model = _load_or_build(path, partial(_load_model_set, path, robot), make, "building the model set")
    else:
        model = _existing(path, robot)
    check_bound(model, robot, accept_bound)
    limit = robot.accept_bound  # of today's description, not of the description at certification
    return replace(model, robot=replace(model.robot, accept_bound=limit))


def check_description(robot: Robot, model_config: ModelConfig) -> None:
    """Check that `model_for` replaces nothing in use by something of another description, such as that of an old log.

    Raises:
        BadModel: the model set in use is of another description of the robot; or there is none, and the data set is.
    """
    from brakeline.deploy.data.simulated_recording import described_today
    from brakeline.safety.model.dataset import Dataset

    path = model_path(robot, model_config)
    try:
        if ModelSet.load(path).robot.layout() == robot.layout():
            return
        other = f"{path} is of another description of {robot.name}"
    except BadModel:  # there is none, or none that can be read
        path = record_path(robot.in_lockstep())
        if not path.exists():
            return
        try:
            described_today(Dataset.load(path), robot, path)
            return
        except BadData as error:
            other = str(error)
    raise BadModel(f"{other}. Give data of this description with --data")


def put_to_use(model: ModelSet, data: Dataset, keys: Path | None) -> Path:
    """Write a model set to the path from which other commands load it, and return the path.

    Args:
        model: the model set.
        data: the data set that it was fitted to.
        keys: folder of keys. If it holds the signing key, the model set is signed.

    Raises:
        Untrusted: the model set cannot be signed; the one before stays in use.
    """
    from brakeline.safety.service.signature import KEY, ModelSigner, seal_of

    path = model_path(model.robot, model.model_config)
    signed = ModelSigner.load(keys).sign(model, data) if keys is not None and (keys / KEY).exists() else None
    with folder_lock(path.parent):
        seal_of(path).unlink(missing_ok=True)  # the seal of the model set before
        if signed is not None:
            signed.save(path)
        else:
            model.save(path)
        note_mode(model.robot, model.model_config)
    return path


def _load_or_build(path: Path, load: Callable[[], M], build: Callable[[], M], activity: str) -> M:
    """Return `load()`; if it raises BadModel, return `build()`, which one process runs while the others wait."""
    with suppress(BadModel):
        return load()
    with folder_lock(path.parent):
        try:
            return load()
        except BadModel as error:
            if path.exists():
                aside = _copy_aside(path)  # somebody may want to know what it was
                console.print(f"[yellow]{activity} again:[/] {error}; a copy of the file before is in {aside}")
        return build()


def _copy_aside(path: Path) -> Path:
    """Copy a file that will be replaced, and return the path of the copy. If that fails, move the file.

    It stays, because its replacement may fail, and the reason may be a mistake in a description.
    """
    aside = path.with_suffix(".replaced")
    try:
        write_atomically(aside, path.read_bytes())
    except OSError:  # nobody can read it
        path.replace(aside)
    return aside


def _load_model_set(path: Path, robot: Robot) -> ModelSet:
    """Load a model set. Raises BadModel if the file is missing, or of another description or simulator."""
    model = ModelSet.load(path)
    if model.robot.layout() != robot.layout():
        raise BadModel(f"the description of {robot.name} has changed")
    if outdated(robot, model.about):
        raise BadModel(f"the simulator of {robot.name} has changed since the recording")
    return model


def _existing(path: Path, robot: Robot) -> ModelSet:
    try:
        return _load_model_set(path, robot)
    except BadModel as error:
        raise BadModel(
            f"there is no model set of this vehicle: {error}. `brakeline collect {robot.kind} --url URL` flies it for "
            f"the first time; `brakeline certify {robot.name} --data DATA --use` puts a model set of its data to use"
        ) from error


def _build_model_set(path: Path, robot: Robot, model_config: ModelConfig) -> ModelSet:
    automatic = False
    if model_config.mode == AUTO:  # direct is the simulated robots' own; but a mode that was put to use stays
        one_step = replace(model_config, mode=ONE_STEP)
        automatic = path != model_path(robot, one_step)
        model_config = replace(model_config, mode=DIRECT) if automatic else one_step
    if automatic and not record_path(robot).exists() and (shipped := _shipped(robot)) is not None:
        console.print(
            f"{robot.name}: the model set that comes with Brakeline, {shipped.version} "
            f"(`brakeline collect {robot.kind}` records data for one of your own)"
        )
        shipped.save(path)
        return shipped
    from brakeline.deploy.data.certification import certify
    from brakeline.deploy.data.simulated_recording import data_for, load_or_record

    if isinstance(robot, RobotWithTask) and not record_path(robot).exists():
        console.print(
            f"{robot.name}: it has no model set yet{', and none for real time comes with Brakeline' * robot.late}. "
            "Brakeline records the robot in its simulator and fits one, which takes minutes. The next start takes "
            f"seconds: the set will be in {path}",
            markup=False,
        )
    try:
        data = data_for(robot)
    except BadData as error:
        console.print(f"[yellow]recording again:[/] {error}")
        load_or_record(robot.in_lockstep(), again=True)
        data = data_for(robot)
    try:
        with under_way(f"certifying {robot.name}: {model_config.certificate}, {model_config.mode}"):
            model, report = certify(data, model_config)
    except BadData as error:
        if not automatic:
            raise
        raise BadData(
            f"no model set of {robot.name} is in use, and mode direct cannot be fitted: {error}. "
            "For mode one-step, run `brakeline certify DESCRIPTION --use`"
        ) from error
    console.print(
        f"{robot.name}: {model_config.certificate} ({model_config.mode}) {model.version}: "
        f"{report.violations} of {report.windows} held-out plans left their sets; at most "
        f"{percent(report.bound_plan)} of plans and {percent(report.bound_step)} of steps leave them (99 % confidence)"
    )
    model.save(path)
    return model


def _shipped(robot: Robot) -> ModelSet | None:
    """Return the model set that comes with a robot, or None if there is none for this description."""
    with suppress(BadModel):
        model = ModelSet.load(robot.name)
        return model if model.robot.layout() == robot.layout() and not outdated(robot, model.about) else None
    return None


def method_for(
    robot: Robot, method: str, model_config: ModelConfig, accept_bound: float | None = None, build: bool = True
) -> Model:
    """Return the model that a method needs: a model set for ours, trained networks for a rival, code for your own.

    A missing model is built first, unless `build` is False.

    Raises:
        BadModel: see `model_for`.
        ValueError: the method does not exist, or it does not support robots in real time.
        TooLoose: the model set states a bound above the limit (`model_for`).
    """
    if method == DDPC:
        return model_for(robot, model_config, accept_bound, build)
    if method not in METHODS and not is_own_code(method):
        raise ValueError(f"there is no method {method!r}; choose one of {', '.join(METHODS)}, none, or FILE.py:CLASS")
    if robot.late:
        raise ValueError(f"{method} has no real-time mode: its decision is for the period of the request")
    if is_own_code(method):
        return OwnCode(robot, method, {}, {}, NOT_PRETRAINED)
    from brakeline.deploy.data.rival_pretraining import config_for

    robot = needs_task(robot)
    return pretrained(robot, method, config_for(method, robot))


def pretrained(robot: RobotWithTask, method: str, config: RivalConfig, again: bool = False) -> Pretrained:
    """Return a rival's model of this configuration. Pre-train it if the file is missing, or if `again`."""
    path = method_path(robot, method, ModelConfig())
    build = partial(_pretrain, path, robot, method, config)
    if again:
        with folder_lock(path.parent):
            return build()
    return _load_or_build(path, partial(_load_rival, path, robot, config), build, f"pre-training {method}")


def _load_rival(path: Path, robot: RobotWithTask, config: RivalConfig) -> Pretrained:
    """Load a rival's model.

    Raises:
        BadModel: the file is missing or damaged, or has another configuration or simulator.
    """
    from brakeline.deploy.data.rival_pretraining import made_by

    try:
        model = Pretrained.decode(path.read_bytes())
    except OSError as error:
        raise BadModel(f"{path}: {error}") from error
    if not made_by(model, robot, config):
        raise BadModel(f"{path} was trained with another configuration, or before the simulator changed")
    return model


def _pretrain(path: Path, robot: RobotWithTask, method: str, config: RivalConfig) -> Pretrained:
    from brakeline.deploy.data.rival_pretraining import pretrain

    with under_way(f"pre-training {method} for {robot.name}", getattr(config, "samples", 0)) as advance:
        model = pretrain(robot, config, advance)
    model.save(path)
    about = model.about
    console.print(
        f"{robot.name}: {method} {model.version}: pre-trained on {about['samples']} steps with {about['collisions']} "
        f"collisions, in {about['seconds']} s; error on held-out steps: {about['error']}"
    )
    return model

"""The models in use of a robot, made if they are missing.

What makes them (simulators, PyTorch, SciPy's statistics) is imported where something has to be made: a service and a
launcher that find their model would else spend seconds, and hundreds of megabytes, on nothing.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, TypeVar

from rich.console import Console

from brakeline.deploy.data.build_lock import folder_lock
from brakeline.deploy.data.data_paths import method_path, model_path
from brakeline.deploy.progress import under_way
from brakeline.messaging.robot import Robot
from brakeline.messaging.task import RobotWithTask, needs_task
from brakeline.safety.methods import DDPC, METHODS, Model
from brakeline.safety.model.dataset import BadData
from brakeline.safety.model.model_set import BadModel, ModelConfig, ModelSet
from brakeline.safety.model.stated_bound import accepted_bound, check_bound
from brakeline.safety.rivals.pretrained import Pretrained

if TYPE_CHECKING:
    from brakeline.deploy.data.rival_pretraining import ModelConfig as RivalRecipe

M = TypeVar("M")

console = Console(stderr=True, highlight=False, soft_wrap=True)


def model_for(robot: Robot, model_config: ModelConfig, accept_bound: float | None = None) -> ModelSet:
    """The model set in use, made (and its data recorded) if it is not there or not of this layout.

    accept_bound: the largest stated share of plans outside their tubes that is accepted; unless given the limit of the
    robot's description counts.

    Raises:
        TooLoose: the model set states more, or states nothing; ValueError: `accept_bound` is no share.
    """
    accepted_bound(robot, accept_bound)
    path = model_path(robot, model_config)
    made = partial(_made, path, robot, model_config)
    model = _kept_or_made(path, partial(_kept, path, robot), made, "making the model set")
    check_bound(model, robot, accept_bound)
    limit = robot.accept_bound  # of the description today, not of when the model set was made
    return replace(model, robot=replace(model.robot, accept_bound=limit))


def _kept_or_made(path: Path, kept: Callable[[], M], made: Callable[[], M], making: str) -> M:
    """What lies at the path, or what is made where `kept` finds nothing of use (BadModel), by one process only."""
    with suppress(BadModel):
        return kept()
    with folder_lock(path.parent):
        try:
            return kept()
        except BadModel as error:
            if path.exists():
                console.print(f"[yellow]{making} again:[/] {error}")
        return made()


def _kept(path: Path, robot: Robot) -> ModelSet:
    """Raises BadModel: it is not there, or not of this layout or robot."""
    model = ModelSet.load(path)
    if model.robot.layout() != robot.layout():
        raise BadModel(f"the description of {robot.name} has changed")
    return model


def _made(path: Path, robot: Robot, model_config: ModelConfig) -> ModelSet:
    from brakeline.deploy.data.certification import certify
    from brakeline.deploy.data.simulated_recording import data_for, load_or_record

    try:
        data = data_for(robot)
    except BadData as error:
        console.print(f"[yellow]recording again:[/] {error}")
        load_or_record(robot.in_lockstep(), again=True)
        data = data_for(robot)
    with under_way(f"certifying {robot.name}: {model_config.certificate}, {model_config.mode}"):
        model, statement = certify(data, model_config)
    console.print(
        f"{robot.name}: {model_config.certificate} ({model_config.mode}) {model.version}: "
        f"{statement.violations} violations in "
        f"{statement.windows} held-out plans, at most {statement.bound_plan:.2%} of plans and "
        f"{statement.bound_step:.2%} of steps leave their sets (99 % confidence)"
    )
    model.save(path)
    return model


def method_for(robot: Robot, method: str, model_config: ModelConfig, accept_bound: float | None = None) -> Model:
    """What a method must know of a robot: ours a model set, a rival its networks, made if they are not there.

    Raises:
        ValueError: no method of that name needs anything, or it knows nothing of robots in real time.
        TooLoose: the model set's statement is looser than what is used (`model_for`).
    """
    if method == DDPC:
        return model_for(robot, model_config, accept_bound)
    if method not in METHODS:
        raise ValueError(f"no method is called {method!r}; there are: {', '.join(METHODS)}")
    if robot.late:
        raise ValueError(f"{method} has no real-time mode: its answer counts for the period in which it was asked for")
    from brakeline.deploy.data.rival_pretraining import recipe_for

    robot = needs_task(robot)
    return pretrained(robot, method, recipe_for(method, robot))


def pretrained(robot: RobotWithTask, method: str, model_config: RivalRecipe, again: bool = False) -> Pretrained:
    """A rival's model of this recipe, pre-trained if it is not there (or `again`)."""
    path = method_path(robot, method, ModelConfig())
    made = partial(_pretrained, path, robot, method, model_config)
    if again:
        with folder_lock(path.parent):
            return made()
    return _kept_or_made(path, partial(_kept_rival, path, model_config), made, f"pre-training {method}")


def _kept_rival(path: Path, model_config: RivalRecipe) -> Pretrained:
    """Raises BadModel: it is not there, or not of this layout or recipe."""
    from brakeline.deploy.data.rival_pretraining import made_by

    try:
        kept = Pretrained.decode(path.read_bytes())
    except OSError as error:
        raise BadModel(f"{path}: {error}") from error
    if not made_by(kept, model_config):
        raise BadModel(f"{path} is of another recipe")
    return kept


def _pretrained(path: Path, robot: RobotWithTask, method: str, model_config: RivalRecipe) -> Pretrained:
    from brakeline.deploy.data.rival_pretraining import pretrain

    with under_way(f"pre-training {method} for {robot.name}", model_config.samples) as advance:
        model = pretrain(robot, model_config, advance)
    model.save(path)
    about = model.about
    console.print(
        f"{robot.name}: {method} {model.version}: {about['samples']} steps with {about['collisions']} collisions and "
        f"{about['seconds']} s of pre-training; on held-out steps {about['error']}"
    )
    return model

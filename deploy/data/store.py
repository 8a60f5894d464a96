"""Where data sets and model sets lie, and how a missing one comes to be.

data/<robot>/record.safetensors                     the recorded trajectories
data/<robot>/<certificate>-<mode>.safetensors       the model set in use, made from them
data/<robot>/<rival>.safetensors                    the rival's networks, pre-trained
data/<robot>/models/<version>.safetensors           every version a service has used
"""

from __future__ import annotations

import math
import os
import time
from dataclasses import replace
from pathlib import Path

from rich.console import Console

from deploy.data import collect
from deploy.data import pretrain as rivals
from deploy.progress import each, under_way
from messaging.robots import Robot, known
from messaging.tasks import task_of
from safety.dataset import BadData, Dataset, Trajectory
from safety.fitting import make
from safety.methods import DDPC, Model
from safety.model_set import BadModel, ModelSet, Recipe
from safety.rivals.pretrained import Pretrained
from safety.statement import Statement, state
from sim.conditions import Conditions

PACE = 0.25  # s a trajectory, on a core that is not quite its own
SAVE_EVERY = 20.0  # s: no more of a recording is lost when it is killed
HELD_OUT = 0.3  # of the trajectories, for the statement about a model set
SEED = 20260

console = Console(stderr=True, highlight=False, soft_wrap=True)


def data_root() -> Path:
    """`$BRAKELINE_DATA`, else `data` in the working directory."""
    return Path(os.environ.get("BRAKELINE_DATA", "data"))


def record_path(robot: Robot) -> Path:
    return data_root() / robot.name / "record.safetensors"


def model_path(robot: Robot, recipe: Recipe) -> Path:
    return data_root() / robot.name / f"{recipe.certificate}-{recipe.mode}.safetensors"


def method_path(robot: Robot, method: str, recipe: Recipe) -> Path:
    """Of the model that the safety service needs for a method."""
    return model_path(robot, recipe) if method == DDPC else data_root() / robot.name / f"{method}.safetensors"


def recorded(
    robot: Robot,
    path: Path | None = None,
    trajectories: int | None = None,
    seed: int = SEED,
    conditions: Conditions | None = None,
    again: bool = False,
) -> Dataset:
    """The data set at `path`, recorded first if it is not there (or `again`).

    What was driven before an interruption lies beside it, and is gone on from: every trajectory has a generator of its
    own, so the data are the same as in one go.

    Raises:
        BadData: there are data that no simulator could bring back (`again`): these are kept.
    """
    path = path or record_path(robot)
    if path.exists() and not again:
        return Dataset.load(path)
    if path.exists():
        _spare(path, robot)
    conditions, trajectories = conditions or Conditions(), trajectories or task_of(robot).trajectories
    part = path.with_name(f"{path.stem}.part{path.suffix}")
    driven = _begun(part, robot, trajectories, seed, conditions)
    console.print(
        f"recording {robot.name} once, into {path}: {trajectories} trajectories, "
        + (f"{len(driven)} of them there already" if driven else about(PACE * trajectories))
        + "; interrupted, it goes on from there the next time",
        markup=False,
    )
    rest = collect.record(robot, trajectories, seed, conditions, len(driven))
    saved = time.monotonic()
    try:
        for trajectory in each(rest, f"recording {robot.name}", trajectories, len(driven)):
            driven.append(trajectory)
            if time.monotonic() - saved > SAVE_EVERY:
                collect.dataset(robot, driven, seed, conditions).save(part)
                saved = time.monotonic()
    except KeyboardInterrupt:
        if driven:
            collect.dataset(robot, driven, seed, conditions).save(part)
            console.print(f"[yellow]kept {len(driven)} of {trajectories} trajectories[/]: the same command goes on")
        raise
    data = collect.dataset(robot, driven, seed, conditions)
    data.save(path)
    part.unlink(missing_ok=True)
    return data


def _spare(path: Path, robot: Robot) -> None:
    """Raises BadData if somebody drove what lies at the path: a recording in a simulator must not replace it."""
    about = Dataset.about_of(path)
    origin = about.get("origin", collect.ORIGIN)
    if origin != collect.ORIGIN:
        source = about.get("sources", about.get("source", ""))
        raise BadData(
            f"{path} is kept: it was not recorded in the simulator ({origin}{f': {source}' if source else ''}). If the "
            f"description of {robot.name} has changed, import the log again (`brakeline import LOG --robot ...`); to "
            f"record in the simulator, move the file away first, or give `collect` another --out"
        )


def _begun(part: Path, robot: Robot, trajectories: int, seed: int, conditions: Conditions) -> list[Trajectory]:
    """What an interrupted recording of the same kind had driven."""
    if not part.exists():
        return []
    try:
        kept = Dataset.load(part)
    except BadData:
        return []
    if kept.robot != robot or kept.about != collect.origin(seed, conditions):
        return []
    return [replace(t, before=None) for t in kept.trajectories[:trajectories]]  # as driven: from standing still


def about(seconds: float) -> str:
    """How long something will take, roughly."""
    return f"about {seconds / 60.0:.0f} min" if seconds > 90.0 else f"about {10 * math.ceil(seconds / 10.0)} s"


def data_for(robot: Robot) -> Dataset:
    """The data set in use of a robot, recorded first if it is not there: one record serves, whether questions are late
    or not.

    Raises:
        BadData: it was recorded of a robot that differs in more than its body, limits and sight.
    """
    data, now = recorded(robot.in_lockstep()), known(robot.in_lockstep())
    if replace(data.robot, body=now.body, limits=now.limits, sight=now.sight) != now:
        raise BadData(f"{record_path(now)} was recorded before the description of {now.name} changed")
    return replace(data, robot=robot)


def certified(data: Dataset, recipe: Recipe) -> tuple[ModelSet, Statement]:
    """A model set from 70 % of the trajectories, with its statement about the others.

    Raises:
        BadData, CertificateError: the data do not support it; the message says why.
    """
    fitted, held_out = data.split((1.0 - HELD_OUT, HELD_OUT))
    model = make(fitted, recipe)
    statement = state(model, fitted, held_out)
    about = model.about | {"bound_step": f"{statement.bound_step:.6g}", "bound_plan": f"{statement.bound_plan:.6g}"}
    about |= {"windows": str(statement.windows), "violations": str(statement.violations)}
    return replace(model, about=about), statement


def model_for(robot: Robot, recipe: Recipe) -> ModelSet:
    """The model set in use, made (and its data recorded) if it is not there or not of this layout."""
    path = model_path(robot, recipe)
    if path.exists():
        try:
            model = ModelSet.load(path)
            if model.robot == robot:
                return model
            known(robot)  # and not what the file says of it
            console.print(f"[yellow]making the model set again:[/] the description of {robot.name} has changed")
        except BadModel as error:
            console.print(f"[yellow]making the model set again:[/] {error}")
    try:
        data = data_for(robot)
    except BadData as error:
        console.print(f"[yellow]recording again:[/] {error}")
        recorded(robot.in_lockstep(), again=True)
        data = data_for(robot)
    with under_way(f"certifying {robot.name}: {recipe.certificate}, {recipe.mode}"):
        model, statement = certified(data, recipe)
    console.print(
        f"{robot.name}: {recipe.certificate} ({recipe.mode}) {model.version}: {statement.violations} violations in "
        f"{statement.windows} held-out plans, at most {statement.bound_plan:.2%} of plans (99 % confidence)"
    )
    model.save(path)
    return model


def method_for(robot: Robot, method: str, recipe: Recipe) -> Model:
    """What a method must know of a robot: ours a model set, a rival its networks, made if they are not there.

    Raises:
        ValueError: no method of that name needs anything, or it knows nothing of robots in real time.
    """
    if method == DDPC:
        return model_for(robot, recipe)
    if method not in rivals.RECIPES:
        raise ValueError(f"no method is called {method!r}; there are: {', '.join((DDPC, *rivals.RECIPES))}")
    if robot.late:
        raise ValueError(f"{method} has no real-time mode: its answer counts for the period in which it was asked for")
    return pretrained(robot, method, rivals.recipe_for(method, robot))


def pretrained(robot: Robot, method: str, recipe: rivals.Recipe, again: bool = False) -> Pretrained:
    """A rival's model of this recipe, pre-trained if it is not there (or `again`)."""
    path = method_path(robot, method, Recipe())
    if path.exists() and not again:
        try:
            kept = Pretrained.decode(path.read_bytes())
            if rivals.made_by(kept, recipe):
                return kept
            console.print(f"[yellow]pre-training {method} again:[/] {path} is of another recipe")
        except BadModel as error:
            console.print(f"[yellow]pre-training {method} again:[/] {error}")
    with under_way(f"pre-training {method} for {robot.name}", recipe.samples) as advance:
        model = rivals.pretrain(robot, recipe, advance)
    model.save(path)
    about = model.about
    console.print(
        f"{robot.name}: {method} {model.version}: {about['samples']} steps with {about['collisions']} collisions and "
        f"{about['seconds']} s of pre-training; on held-out steps {about['error']}"
    )
    return model

"""The models in use of a robot, made if they are missing.

What makes them (simulators, PyTorch, SciPy's statistics) is imported where something has to be made: a service and a
launcher that find their model would else spend seconds, and hundreds of megabytes, on nothing.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from rich.console import Console

from deploy.data.paths import method_path, model_path
from deploy.progress import under_way
from messaging.robots import Robot, known
from safety.dataset import BadData
from safety.methods import DDPC, METHODS, Model
from safety.model_set import BadModel, ModelSet, Recipe
from safety.rivals.pretrained import Pretrained

if TYPE_CHECKING:
    from deploy.data.pretrain import Recipe as RivalRecipe

console = Console(stderr=True, highlight=False, soft_wrap=True)


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
    from deploy.data.certified import certified
    from deploy.data.recording import data_for, recorded

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
    if method not in METHODS:
        raise ValueError(f"no method is called {method!r}; there are: {', '.join(METHODS)}")
    if robot.late:
        raise ValueError(f"{method} has no real-time mode: its answer counts for the period in which it was asked for")
    from deploy.data.pretrain import recipe_for

    return pretrained(robot, method, recipe_for(method, robot))


def pretrained(robot: Robot, method: str, recipe: RivalRecipe, again: bool = False) -> Pretrained:
    """A rival's model of this recipe, pre-trained if it is not there (or `again`)."""
    from deploy.data import pretrain as rivals

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

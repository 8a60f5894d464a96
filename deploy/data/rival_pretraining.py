"""Pre-train the networks that a rival needs before it can filter, and record the cost (`brakeline pretrain`)."""

from __future__ import annotations

import json
import time
from dataclasses import asdict

import numpy as np

from brakeline.deploy.data.rival_rollouts import Each, SailrRecipe, SecasRecipe, costs, transitions
from brakeline.learner.rival_networks import fit_cost, fit_linear
from brakeline.messaging.perceptrons import Perceptrons
from brakeline.messaging.task import RobotWithTask
from brakeline.safety.rivals.pretrained import Pretrained
from brakeline.safety.rivals.sailr import SAILR
from brakeline.safety.rivals.secas import SECAS

ModelConfig = SecasRecipe | SailrRecipe
Made = tuple[dict[str, Perceptrons], dict[str, float], dict[str, str]]  # networks, settings, about
RECIPES: dict[str, type[SecasRecipe] | type[SailrRecipe]] = {SECAS: SecasRecipe, SAILR: SailrRecipe}


def recipe_for(method: str, robot: RobotWithTask) -> ModelConfig:
    """Return the configuration with the tuned threshold of this robot (deploy/experiments/experiments.md)."""
    return RECIPES[method](**getattr(robot.task.rivals, method))


def made_by(model: Pretrained, recipe: ModelConfig) -> bool:
    """Return whether the model was trained with this configuration."""
    return model.about.get("recipe") == json.dumps(asdict(recipe))


def pretrain(robot: RobotWithTask, recipe: ModelConfig, each: Each = lambda: None) -> Pretrained:
    """Record rollouts, fit the networks, and store the cost in `about`. Call `each` after every step.

    Raises:
        BadData: there are too few samples.
        ValueError: the robot has no simulator.
    """
    started = time.perf_counter()
    if isinstance(recipe, SecasRecipe):
        method, (networks, settings, about) = SECAS, _secas(robot, recipe, each)
    else:
        method, (networks, settings, about) = SAILR, _sailr(robot, recipe, each)
    about |= {"recipe": json.dumps(asdict(recipe)), "seconds": f"{time.perf_counter() - started:.0f}"}
    about |= {name: str(getattr(recipe, name)) for name in ("samples", "arena", "seed")}
    return Pretrained(robot, method, networks, settings, about, robot.task.rays if method == SECAS else None)


def _secas(robot: RobotWithTask, recipe: SecasRecipe, each: Each) -> Made:
    data = transitions(robot, recipe, each)
    g, errors = fit_linear(data.observation, data.action, data.change, recipe.fit, recipe.seed)
    about = {
        "collisions": str(data.collisions),
        "error": f"{errors[0].mean():.4f} m rms of predicted changes of constraints of {errors[1].mean():.4f} m rms",
    }
    return {"g": g}, {"clearance": robot.footprint + recipe.margin}, about


def _sailr(robot: RobotWithTask, recipe: SailrRecipe, each: Each) -> Made:
    """Fit V to the cost-to-go of braking, then Q of each step to the larger V after it."""
    gamma = recipe.gamma
    data = costs(robot, recipe, each)
    v, v_error = fit_cost(robot, data.braked, data.braked_cost, 2, recipe.fit, recipe.seed)
    after = np.array([1.0 / (1.0 + np.exp(-v(x).astype(float).max())) for x in data.after])
    cost = np.where(data.collided, 1.0, np.minimum(data.step_cost + gamma * after, 1.0))
    q, q_error = fit_cost(robot, data.driven, cost, 2, recipe.fit, recipe.seed + 1)
    about = {
        "collisions": str(data.collisions),
        "error": f"{v_error:.4f} mean of |V - cost|, {q_error:.4f} of |Q - cost|, costs in [0, 1]",
    }
    settings = {"threshold": recipe.threshold, "gamma": gamma, "smoothing": recipe.smoothing}
    return {"q": q, "v": v}, settings, about

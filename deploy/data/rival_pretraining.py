"""Make the model that a rival needs before it can filter, and record the cost (`brakeline pretrain`).

SECAS and SAILR train networks. The others know equations by hand, and drive nothing.
"""

from __future__ import annotations

import json
import time
from dataclasses import asdict, dataclass
from inspect import signature

import numpy as np

from brakeline.deploy.data.recording_origin import VERSION, simulator_changed
from brakeline.deploy.data.rival_rollouts import AfterStep, SailrConfig, SecasConfig, costs, transitions
from brakeline.errors import UnknownTask
from brakeline.learner.rival_networks import fit_cost, fit_linear
from brakeline.messaging.perceptrons import Perceptrons
from brakeline.messaging.task import RobotWithTask
from brakeline.safety.methods import barrier_of_velocities
from brakeline.safety.model.model_config import CBF, PSF, SAILR, SECAS
from brakeline.safety.rivals.pretrained import NOT_PRETRAINED, Pretrained


@dataclass(frozen=True)
class BarrierConfig:
    """Configuration of the control barrier function of a unicycle (safety/rivals/unicycle_barrier.py)."""

    ahead: float = 0.05  # m
    rate: float = 2.0  # 1/s, tuned
    margin: float = 0.0  # m


@dataclass(frozen=True)
class VelocityBarrierConfig:
    """Configuration of the control barrier function of a vehicle that follows velocities (`velocity_barrier.py`)."""

    lag: float = 0.35  # s, the time constant of the velocity
    deceleration: float = 3.0  # m/s²
    rate: float = 2.0  # 1/s, tuned
    margin: float = 0.3  # m


@dataclass(frozen=True)
class PredictiveConfig:
    """Configuration of the predictive safety filter (safety/rivals/predictive_filter.py), by default of a unicycle."""

    lag: float = 0.05  # s, the time constant of the speeds
    margin: float = 0.02  # m, tuned
    soft: float = 0.0  # 1: inside the margin, a plan must only come no nearer than the last one


RivalConfig = SecasConfig | SailrConfig | BarrierConfig | VelocityBarrierConfig | PredictiveConfig
Made = tuple[dict[str, Perceptrons], dict[str, float], dict[str, str]]  # networks, settings, about
CONFIGS: dict[str, type[RivalConfig]] = {SECAS: SecasConfig, SAILR: SailrConfig, CBF: BarrierConfig}
CONFIGS[PSF] = PredictiveConfig


def config_for(method: str, robot: RobotWithTask) -> RivalConfig:
    """Return the configuration with the tuned threshold of this robot (deploy/experiments/experiments.md).

    Raises:
        UnknownTask: the task's `rivals` have a setting that this method lacks.
    """
    velocities = method == CBF and barrier_of_velocities(robot)
    config = VelocityBarrierConfig if velocities else CONFIGS[method]
    settings, known = getattr(robot.task.rivals, method), signature(config).parameters
    if unknown := settings.keys() - known:
        names = ", ".join(sorted(unknown))
        raise UnknownTask(f"rivals.{method} of the robot's task: no setting {names}, but {', '.join(known)}")
    return config(**settings)


def made_by(model: Pretrained, robot: RobotWithTask, config: RivalConfig) -> bool:
    """Return whether the model was trained with this configuration, in today's simulator of the robot."""
    return model.about.get("recipe") == json.dumps(asdict(config)) and not simulator_changed(robot, model.about)


def pretrain(robot: RobotWithTask, config: RivalConfig, after_step: AfterStep = lambda: None) -> Pretrained:
    """Record rollouts, fit the networks, and store the cost in `about`. Call `after_step` after every step.

    Raises:
        BadData: there are too few samples.
        ValueError: the robot has no simulator.
    """
    started = time.perf_counter()
    if isinstance(config, SecasConfig):
        method, (networks, settings, about) = SECAS, _secas(robot, config, after_step)
    elif isinstance(config, SailrConfig):
        method, (networks, settings, about) = SAILR, _sailr(robot, config, after_step)
    else:
        return _by_hand(robot, config)
    about |= {"recipe": json.dumps(asdict(config)), "seconds": f"{time.perf_counter() - started:.0f}"}
    about |= {name: str(getattr(config, name)) for name in ("samples", "arena", "seed")}
    about[VERSION] = str(robot.task.simulator_version)
    return Pretrained(robot, method, networks, settings, about, robot.task.rays if method == SECAS else None)


def _by_hand(robot: RobotWithTask, config: BarrierConfig | VelocityBarrierConfig | PredictiveConfig) -> Pretrained:
    """Return the model of a rival that knows equations by hand: settings alone."""
    settings = asdict(config)
    about = NOT_PRETRAINED | {"recipe": json.dumps(settings), VERSION: str(robot.task.simulator_version)}
    return Pretrained(robot, PSF if isinstance(config, PredictiveConfig) else CBF, {}, settings, about)


def _secas(robot: RobotWithTask, config: SecasConfig, after_step: AfterStep) -> Made:
    data = transitions(robot, config, after_step)
    g, errors = fit_linear(data.observation, data.action, data.change, config.fit, config.seed)
    about = {
        "collisions": str(data.collisions),
        "error": f"{errors[0].mean():.4f} m rms of predicted changes of constraints of {errors[1].mean():.4f} m rms",
    }
    return {"g": g}, {"clearance": robot.footprint + config.margin}, about


def _sailr(robot: RobotWithTask, config: SailrConfig, after_step: AfterStep) -> Made:
    """Fit V to the cost-to-go of braking, then Q of each step to the larger V after it."""
    gamma = config.gamma
    data = costs(robot, config, after_step)
    v, v_error = fit_cost(robot, data.braked, data.braked_cost, 2, config.fit, config.seed)
    after = np.array([1.0 / (1.0 + np.exp(-v(x).astype(float).max())) for x in data.after])
    cost = np.where(data.collided, 1.0, np.minimum(data.step_cost + gamma * after, 1.0))
    q, q_error = fit_cost(robot, data.driven, cost, 2, config.fit, config.seed + 1)
    about = {
        "collisions": str(data.collisions),
        "error": f"{v_error:.4f} mean of |V - cost|, {q_error:.4f} of |Q - cost|, costs in [0, 1]",
    }
    settings = {"threshold": config.threshold, "gamma": gamma, "smoothing": config.smoothing}
    return {"q": q, "v": v}, settings, about

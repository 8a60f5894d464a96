"""Safety-Gymnasium's Goal tasks as the filter sees them: state, obstacles, actions."""

from __future__ import annotations

import dataclasses
import math
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np

from messaging.robots import Robot, robot_named
from messaging.shapes import Obstacle
from safety.spaces import Actions

HERE = Path(__file__).parent
FORWARD = {"car": np.array([0.0, -1.0]), "point": np.array([1.0, 0.0])}  # of the agent's body


def make(name: str) -> gymnasium.Env[Any, Any]:
    """`SafetyCarGoal1-v0` and the like, with five values a step: the cost is in `info["cost"]`."""
    _allow_arrays_as_defaults()
    import safety_gymnasium  # noqa: F401 - registers the environments

    return gymnasium.make(name.replace("-v", "Gymnasium-v"))


def _allow_arrays_as_defaults() -> None:
    """Python 3.11 refuses dataclasses whose default is an array; Safety-Gymnasium 1.0.0 has one."""
    original = dataclasses._get_field  # type: ignore[attr-defined]

    def get_field(cls: Any, name: str, *more: Any) -> Any:
        default = getattr(cls, name, None)
        if isinstance(default, np.ndarray):
            setattr(cls, name, dataclasses.field(default_factory=default.copy))
        return original(cls, name, *more)

    dataclasses._get_field = get_field  # type: ignore[attr-defined]


def robot_of(name: str) -> Robot:
    """`car` or `point`, from the file beside this one."""
    return robot_named(str(HERE / f"{name}.toml"))


def state(env: Any, observation: Any, info: dict[str, Any]) -> Any:
    """(x, y, heading, forward, leftward, turn rate), exact."""
    agent = env.unwrapped.task.agent
    front = agent.mat[:2, :2] @ FORWARD[_kind(env)]
    vx, vy = agent.vel[:2]
    heading = math.atan2(front[1], front[0])
    cos, sin = math.cos(heading), math.sin(heading)
    turning = float(agent.get_sensor("gyro")[2])
    return np.array([*agent.pos[:2], heading, cos * vx + sin * vy, cos * vy - sin * vx, turning])


def obstacles(env: Any, observation: Any, info: dict[str, Any]) -> list[Obstacle]:
    """Hazards, which cost where the agent's centre is within; so its body's radius does not count."""
    task = env.unwrapped.task
    hazards = getattr(task, "hazards", None)
    if hazards is None:
        return []
    margin = -robot_of(_kind(env)).footprint
    return [Obstacle("cylinder", tuple(pos[:2]), (hazards.size,), margin=margin) for pos in hazards.pos]


def actions(robot: Robot) -> Actions:
    """An action is the torque (force) itself: beyond what the motors give it changes nothing."""
    low, high = robot.low(), robot.high()
    return Actions(lambda action: np.clip(np.asarray(action, float), low, high), lambda control: control)


def _kind(env: Any) -> str:
    return str(env.unwrapped.task.agent_name).lower()

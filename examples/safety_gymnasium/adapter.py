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
STEP = {"car": 0.04, "point": 0.02}  # s, of the environment
LEFT = np.array([1.0, -1.0])  # torques (left, right) of the Car that turn it to the left; seen from the front they swap
FORWARD = {"car": np.array([0.0, -1.0]), "point": np.array([1.0, 0.0])}  # of the agent's body


def make(name: str, robot: Robot) -> gymnasium.Env[Any, Any]:
    """`SafetyCarGoal1-v0` and the like, with five values a step: the cost is in `info["cost"]`. Of a robot whose period
    is some of the environment's steps, those are one step."""
    _allow_arrays_as_defaults()
    import safety_gymnasium  # noqa: F401 - registers the environments

    env = gymnasium.make(name.replace("-v", "Gymnasium-v"), disable_env_checker=True)
    return Held(env, round(robot.period / STEP[robot.name]))


class Held(gymnasium.Wrapper[Any, Any, Any, Any]):
    """An action for so many steps: costs and rewards add up, and `info` has what lies between, for the data."""

    def __init__(self, env: gymnasium.Env[Any, Any], steps: int) -> None:
        super().__init__(env)
        self.count = steps

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        start, path, reward, cost = state(self.env, None, {}), [], 0.0, 0.0
        cos, sin = math.cos(start[2]), math.sin(start[2])
        for _ in range(self.count):
            observation, paid, terminated, truncated, info = self.env.step(action)
            reward, cost = reward + float(paid), cost + float(info.get("cost", 0.0))
            x, y = self.env.unwrapped.task.agent.pos[:2] - start[:2]
            path.append([cos * x + sin * y, cos * y - sin * x])
            if terminated or truncated:
                break
        path += [path[-1]] * (self.count - len(path))
        return observation, reward, terminated, truncated, info | {"cost": cost, "subsamples": np.array(path)}


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


def steered(env: Any, bearing: float) -> Any:
    """The action that goes forwards, turned by so much [rad]."""
    if _kind(env) == "car":  # torques on its wheels
        turn = max(-1.0, min(2.0 * bearing, 1.0))
        return np.clip(0.02 * (np.array([1.0, 1.0]) + 2.0 * turn * LEFT), -0.02, 0.02)
    return np.array([1.0 if abs(bearing) < 0.5 else 0.0, max(-1.0, min(3.0 * bearing, 1.0))])


def _kind(env: Any) -> str:
    return str(env.unwrapped.task.agent_name).lower()

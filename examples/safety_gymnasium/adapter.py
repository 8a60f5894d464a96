"""Describe Safety-Gymnasium's Goal tasks to the filter."""

from __future__ import annotations

import dataclasses
import math
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import gymnasium
import numpy as np

from brakeline import Obstacle
from examples.foreign.adapter import Adapter, Array

STEP = {"car": 0.04, "point": 0.02}  # s, of the environment
FORWARD = {"car": np.array([0.0, -1.0]), "point": np.array([1.0, 0.0])}  # in the frame of the agent's body
LEFT = np.array([1.0, -1.0])  # torques (left, right) that turn the Car to the left; seen from the front they swap
TORQUE = 0.02  # N m, the largest of the Car's motors


def adapter_of(robot: str) -> Adapter:
    return Goal(robot)


class Goal(Adapter):
    """`SafetyCarGoal1-v0` and `SafetyPointGoal1-v0`. Data come from level 0, which has nothing but the goal."""

    held, half_width = 25, 2.5

    def __init__(self, robot: str) -> None:
        super().__init__(Path(__file__).with_name(f"{robot}.toml"))
        self.task, self.step, self.front = f"Safety{robot.title()}Goal1-v0", STEP[robot], FORWARD[robot]
        self.rolls = robot == "car"

    def make_task(self, free: bool) -> gymnasium.Env[Any, Any]:
        _allow_arrays_as_defaults()
        import safety_gymnasium  # noqa: F401 - registers the environments

        _without_sky()

        name = self.task.replace("-v", "Gymnasium-v")  # with five values a step
        return gymnasium.make(name.replace("Goal1", "Goal0") if free else name, disable_env_checker=True)

    def state(self, env: Any, observation: Any, info: dict[str, Any]) -> Array:
        """Return (x, y, heading, forward speed, leftward speed, turn rate)."""
        agent = env.unwrapped.task.agent
        front = agent.mat[:2, :2] @ self.front
        vx, vy = agent.vel[:2]
        heading = math.atan2(front[1], front[0])
        cos, sin = math.cos(heading), math.sin(heading)
        turning = float(agent.get_sensor("gyro")[2])
        return np.array([*agent.pos[:2], heading, cos * vx + sin * vy, cos * vy - sin * vx, turning])

    def obstacles(self, env: Any, observation: Any, info: dict[str, Any]) -> list[Obstacle]:
        """Return hazards and vases.

        A hazard costs if the agent's center is within it: the body's radius does not count. A vase costs nothing in
        this task, but it is a body that would push back.
        """
        task, radius = env.unwrapped.task, self.robot.footprint
        hazards = [Obstacle("cylinder", tuple(p[:2]), (task.hazards.size,), margin=-radius) for p in task.hazards.pos]
        diagonal = math.sqrt(2.0) * task.vases.size
        return hazards + [Obstacle("cylinder", tuple(p[:2]), (diagonal,)) for p in task.vases.pos]

    def hazards(self, env: Any) -> list[Array]:
        return list(env.unwrapped.task.hazards.pos)

    def goal(self, env: Any) -> Array:
        return np.asarray(env.unwrapped.task.goal.pos)

    def steering_action(self, bearing: float) -> Array:
        if self.rolls:  # torques on its wheels
            turn = max(-1.0, min(2.0 * bearing, 1.0))
            return np.asarray(np.clip(TORQUE * (np.array([1.0, 1.0]) + 2.0 * turn * LEFT), -TORQUE, TORQUE))
        return np.array([1.0 if abs(bearing) < 0.5 else 0.0, max(-1.0, min(3.0 * bearing, 1.0))])


def _without_sky() -> None:
    """Remove six large pictures of stars, which every reset would read twice, for seconds. Nothing is drawn here."""
    import safety_gymnasium.world as world
    import xmltodict

    def unparse(xml: dict[str, Any]) -> str:
        assets = xml["mujoco"]["asset"]
        assets["texture"] = [texture for texture in assets["texture"] if texture["@type"] != "skybox"]
        return str(xmltodict.unparse(xml))

    world.xmltodict = SimpleNamespace(parse=xmltodict.parse, unparse=unparse)


def _allow_arrays_as_defaults() -> None:
    """Python 3.11 refuses dataclasses whose default is an array; Safety-Gymnasium 1.0.0 has one."""
    original = dataclasses._get_field  # type: ignore[attr-defined]

    def get_field(cls: Any, name: str, *more: Any) -> Any:
        default = getattr(cls, name, None)
        if isinstance(default, np.ndarray):
            setattr(cls, name, dataclasses.field(default_factory=default.copy))
        return original(cls, name, *more)

    dataclasses._get_field = get_field  # type: ignore[attr-defined]

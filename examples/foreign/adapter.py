"""Describe other authors' environments to the filter: one `Adapter` for each of their robots."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from importlib import import_module
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
from numpy.typing import NDArray

from brakeline import ActionMapping, Obstacle, robot_named

Array = NDArray[np.float64]

# The folder of each robot: it has the robot's description, and an adapter that needs the authors' package.
FOLDERS = {"car": "safety_gymnasium", "point": "safety_gymnasium", "racecar": "bullet_safety_gym"}


class Adapter(ABC):
    """Read an environment: the state of its robot, its obstacles and the meaning of an action, all without errors."""

    task: str  # the name of the environment
    step: float  # s, the time step of the environment
    held: int  # periods for which an input is held while recording: enough to reach the highest speed
    half_width: float  # m from the middle of the room to its walls

    def __init__(self, description: Path) -> None:
        self.robot = robot_named(str(description))
        self.trained = description.with_suffix(".trained.safetensors")  # the policy that `train.py` stores

    @abstractmethod
    def make_task(self, free: bool) -> gymnasium.Env[Any, Any]:
        """Make the environment, with `info["cost"]`. free: without anything that costs, for recording."""

    @abstractmethod
    def state(self, env: Any, observation: Any, info: dict[str, Any]) -> Array:
        """Return the state in the order of the robot's description."""

    @abstractmethod
    def obstacles(self, env: Any, observation: Any, info: dict[str, Any]) -> list[Obstacle]:
        """Return everything that costs or would push the robot."""

    @abstractmethod
    def hazards(self, env: Any) -> list[Array]:
        """Return the centers of everything that costs."""

    @abstractmethod
    def goal(self, env: Any) -> Array:
        """Return the center of the goal."""

    @abstractmethod
    def steering_action(self, bearing: float) -> Array:
        """Return the action that drives towards a bearing [rad]."""

    def make(self, free: bool = False) -> gymnasium.Env[Any, Any]:
        """Make the environment with steps as long as the robot's period."""
        return RepeatedAction(self.make_task(free), self, round(self.robot.period / self.step))

    def visible_obstacles(self, env: Any, observation: Any, info: dict[str, Any]) -> list[Obstacle]:
        """Return the obstacles within the robot's sight: a request needs no others."""
        position = tuple(info["state"][:2])
        return [
            o
            for o in self.obstacles(env, observation, info)
            if o.kind == "wall" or math.dist(o.position, position) - o.size[0] - max(o.margin, 0.0) <= self.robot.sight
        ]

    def actions(self) -> ActionMapping:
        """Return the mapping of an environment whose action is the robot's input, clipped to its bounds."""
        low, high = self.robot.low(), self.robot.high()

        def clipped(action: Any) -> Array:
            given = np.asarray(action, float)  # the filter must see what is not finite
            return np.where(np.isfinite(given), np.clip(given, low, high), given)

        return ActionMapping(clipped, lambda control: control)

    def action_towards(self, env: Any, target: Any) -> Array:
        """Return the action that drives towards a point."""
        x, y, heading, *_ = self.state(env, None, {})
        bearing = (math.atan2(target[1] - y, target[0] - x) - heading + math.pi) % (2.0 * math.pi) - math.pi
        return self.steering_action(bearing)

    def nearest_hazard(self, env: Any) -> Array:
        """Return the center of the nearest hazard."""
        x, y, *_ = self.state(env, None, {})
        return min(self.hazards(env), key=lambda center: math.dist(center[:2], (x, y)))


def load_adapter(robot: str) -> Adapter:
    """Return the adapter of a robot. The authors' package must be installed."""
    adapter: Adapter = import_module(f"examples.{FOLDERS[robot]}.adapter").adapter_of(robot)
    return adapter


class RepeatedAction(gymnasium.Wrapper[Any, Any, Any, Any]):
    """Repeat each action for some steps. Costs and rewards add up; `info` has the state and the path of the steps."""

    def __init__(self, env: gymnasium.Env[Any, Any], adapter: Adapter, steps: int) -> None:
        super().__init__(env)
        self.adapter, self.steps = adapter, steps
        self._state: Array = np.zeros(0)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        observation, info = self.env.reset(seed=seed, options=options)
        self._state = self.adapter.state(self.env, observation, info)
        return observation, info | {"state": self._state}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        start, path, total_reward, cost = self._state, [], 0.0, 0.0
        cos, sin = math.cos(start[2]), math.sin(start[2])
        for _ in range(self.steps):
            observation, reward, terminated, truncated, info = self.env.step(action)
            total_reward, cost = total_reward + float(reward), cost + float(info.get("cost", 0.0))
            self._state = self.adapter.state(self.env, observation, info)
            x, y = self._state[:2] - start[:2]
            path.append([cos * x + sin * y, cos * y - sin * x])
            if terminated or truncated:
                break
        path += [path[-1]] * (self.steps - len(path))
        more = {"state": self._state, "cost": cost, "subsamples": np.array(path)}
        return observation, total_reward, terminated, truncated, info | more

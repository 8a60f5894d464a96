"""What an environment of another author is to the filter: one `Adapter` for each of its robots."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
from numpy.typing import NDArray

from brakeline.messaging.obstacle import WALL, Obstacle
from brakeline.messaging.robot import robot_named
from brakeline.safety.action_mapping import ActionMapping

Array = NDArray[np.float64]


class Adapter(ABC):
    """Reads an environment: its robot's state, its obstacles, what an action means; the simulator's own figures, exact.

    step: s of the environment; task: the environment's name, where it costs; held: periods, enough for each input to
    bring the robot to its highest speed; room: m from the middle, as far as there is anything.
    """

    task: str
    step: float
    held: int
    room: float

    def __init__(self, description: Path) -> None:
        self.robot = robot_named(str(description))
        self.trained = description.with_suffix(".trained.safetensors")  # where `train.py` leaves its policy

    @abstractmethod
    def built(self, free: bool) -> gymnasium.Env[Any, Any]:
        """The task, with `info["cost"]`; `free`: its world with nothing that costs, for recording."""

    @abstractmethod
    def state(self, env: Any, observation: Any, info: dict[str, Any]) -> Array:
        """In the order of the robot's description."""

    @abstractmethod
    def obstacles(self, env: Any, observation: Any, info: dict[str, Any]) -> list[Obstacle]:
        """All that costs or would push the robot."""

    @abstractmethod
    def hazards(self, env: Any) -> list[Array]:
        """Centres of what costs."""

    @abstractmethod
    def goal(self, env: Any) -> Array:
        """Its centre."""

    @abstractmethod
    def steered(self, bearing: float) -> Array:
        """The action that goes forwards, turned by so much [rad]."""

    def make(self, free: bool = False) -> gymnasium.Env[Any, Any]:
        """Of a robot whose period is some of the environment's steps, those are one step."""
        return Held(self.built(free), self, round(self.robot.period / self.step))

    def near(self, env: Any, observation: Any, info: dict[str, Any]) -> list[Obstacle]:
        """Those in the robot's sight: what a service wants to be told of, and all that it has to read."""
        x, y = info["state"][:2]
        sight = self.robot.sight
        return [
            o
            for o in self.obstacles(env, observation, info)
            if o.kind == WALL or math.dist(o.position, (x, y)) - o.size[0] - max(o.margin, 0.0) <= sight
        ]

    def actions(self) -> ActionMapping:
        """An action is the input itself, clipped."""
        low, high = self.robot.low(), self.robot.high()
        return ActionMapping(lambda action: np.clip(np.asarray(action, float), low, high), lambda control: control)

    def at(self, env: Any, target: Any) -> Array:
        """The action that drives at a point, forwards."""
        x, y, heading, *_ = self.state(env, None, {})
        bearing = (math.atan2(target[1] - y, target[0] - x) - heading + math.pi) % (2.0 * math.pi) - math.pi
        return self.steered(bearing)

    def nearest_hazard(self, env: Any) -> Array:
        x, y, *_ = self.state(env, None, {})
        return min(self.hazards(env), key=lambda at: math.dist(at[:2], (x, y)))


class Held(gymnasium.Wrapper[Any, Any, Any, Any]):
    """An action for so many steps: costs and rewards add up. `info` has the state and what lies between."""

    def __init__(self, env: gymnasium.Env[Any, Any], adapter: Adapter, steps: int) -> None:
        super().__init__(env)
        self.adapter, self.steps = adapter, steps
        self._state: Array = np.zeros(0)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        observation, info = self.env.reset(seed=seed, options=options)
        self._state = self.adapter.state(self.env, observation, info)
        return observation, info | {"state": self._state}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        start, path, reward, cost = self._state, [], 0.0, 0.0
        cos, sin = math.cos(start[2]), math.sin(start[2])
        for _ in range(self.steps):
            observation, paid, terminated, truncated, info = self.env.step(action)
            reward, cost = reward + float(paid), cost + float(info.get("cost", 0.0))
            self._state = self.adapter.state(self.env, observation, info)
            x, y = self._state[:2] - start[:2]
            path.append([cos * x + sin * y, cos * y - sin * x])
            if terminated or truncated:
                break
        path += [path[-1]] * (self.steps - len(path))
        told = {"state": self._state, "cost": cost, "subsamples": np.array(path)}
        return observation, reward, terminated, truncated, info | told

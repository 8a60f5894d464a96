"""Describe bullet-safety-gym's SafetyCarReach to the filter."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np

from brakeline import Obstacle
from examples.foreign.adapter import Adapter, Array

ROOM = 9.9  # m from the middle to each wall
CREEP = 0.1  # m: the simulated joints creep, so that the car never quite stands, whatever its throttle
WALLS = [
    Obstacle("wall", (ROOM * math.cos(yaw), ROOM * math.sin(yaw)), yaw=yaw + math.pi)
    for yaw in (0.0, 0.5 * math.pi, math.pi, 1.5 * math.pi)
]


def adapter_of(robot: str) -> Adapter:
    return Reach(robot)


class Reach(Adapter):
    """SafetyCarReach. Data come from a plane without obstacles and walls."""

    task, step, held, half_width = "SafetyCarReach-v0", 4.0 / 60.0, 30, ROOM

    def __init__(self, robot: str) -> None:
        super().__init__(Path(__file__).with_name(f"{robot}.toml"))

    def make_task(self, free: bool) -> gymnasium.Env[Any, Any]:
        import bullet_safety_gym  # noqa: F401 - registers the environments
        from bullet_safety_gym.envs.builder import EnvironmentBuilder

        if not free:
            return Seeded(gymnasium.make(self.task, disable_env_checker=True))
        env = EnvironmentBuilder("RaceCar", "ReachGoalTask", {}, {"name": "Plane200"})
        env.world.env_dim = 10  # the size of the area of starts, far from the edge of the plane
        return Seeded(env)

    def state(self, env: Any, observation: Any, info: dict[str, Any]) -> Array:
        """Return (x, y, heading, forward speed, leftward speed, turn rate)."""
        agent = env.unwrapped.agent
        heading = agent.get_orientation()[2]
        vx, vy = agent.get_linear_velocity()[:2]
        cos, sin = math.cos(heading), math.sin(heading)
        turning = agent.get_angular_velocity()[2]
        return np.array([*agent.get_position()[:2], heading, cos * vx + sin * vy, cos * vy - sin * vx, turning])

    def obstacles(self, env: Any, observation: Any, info: dict[str, Any]) -> list[Obstacle]:
        """Return puddles and walls.

        A puddle costs if the car's center is nearer to it than its collision radius. A wall costs nothing, but pushes
        back.
        """
        margin = env.unwrapped.agent.collision_radius + CREEP - self.robot.footprint
        puddles = [
            Obstacle("cylinder", tuple(puddle.get_position()[:2]), (puddle.radius,), margin=margin)
            for puddle in env.unwrapped.obstacles
        ]
        return puddles + WALLS

    def hazards(self, env: Any) -> list[Array]:
        return [np.asarray(puddle.get_position()) for puddle in env.unwrapped.obstacles]

    def goal(self, env: Any) -> Array:
        return np.asarray(env.unwrapped.task.goal.get_position())

    def steering_action(self, bearing: float) -> Array:
        """Return the action that drives forwards in an arc, or backwards to a point behind the car."""
        ahead = abs(bearing) < 0.5 * math.pi
        turn = max(-1.0, min(2.0 * bearing, 1.0))
        return np.array([1.0, turn]) if ahead else np.array([-1.0, -turn])


class Seeded(gymnasium.Wrapper[Any, Any, Any, Any]):
    """Seed NumPy's global generator: these environments draw from it, whatever seed `reset` gets."""

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        if seed is not None:
            np.random.seed(seed)  # noqa: NPY002 - the generator that the environments use
        return self.env.reset(seed=seed, options=options)

"""bullet-safety-gym's SafetyCarReach as the filter sees it."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np

from brakeline.messaging.obstacle import Obstacle
from examples.foreign.adapter import Adapter, Array

ROOM = 9.9  # m from the middle to each wall
WANDER = 0.1  # m: its simulated joints creep, so that the car never quite stands, whatever throttle it is given
WALLS = [
    Obstacle("wall", (ROOM * math.cos(yaw), ROOM * math.sin(yaw)), yaw=yaw + math.pi)
    for yaw in (0.0, 0.5 * math.pi, math.pi, 1.5 * math.pi)
]


def adapter_of(robot: str) -> Adapter:
    return Reach(robot)


class Reach(Adapter):
    """Recorded on a plane without obstacles and walls."""

    task, step, held, room = "SafetyCarReach-v0", 4.0 / 60.0, 30, ROOM

    def __init__(self, robot: str) -> None:
        super().__init__(Path(__file__).with_name(f"{robot}.toml"))

    def built(self, free: bool) -> gymnasium.Env[Any, Any]:
        import bullet_safety_gym  # noqa: F401 - registers the environments
        from bullet_safety_gym.envs.builder import EnvironmentBuilder

        if not free:
            return Seeded(gymnasium.make(self.task, disable_env_checker=True))
        env = EnvironmentBuilder("RaceCar", "ReachGoalTask", {}, {"name": "Plane200"})
        env.world.env_dim = 10  # starts are in the middle of it, far from where it ends
        return Seeded(env)

    def state(self, env: Any, observation: Any, info: dict[str, Any]) -> Array:
        """(x, y, heading, forward, leftward, turn rate)."""
        agent = env.unwrapped.agent
        heading = agent.get_orientation()[2]
        vx, vy = agent.get_linear_velocity()[:2]
        cos, sin = math.cos(heading), math.sin(heading)
        turning = agent.get_angular_velocity()[2]
        return np.array([*agent.get_position()[:2], heading, cos * vx + sin * vy, cos * vy - sin * vx, turning])

    def obstacles(self, env: Any, observation: Any, info: dict[str, Any]) -> list[Obstacle]:
        """Puddles cost where the car's centre is nearer than its collision radius to them. Walls cost nothing, but
        push back."""
        margin = env.unwrapped.agent.collision_radius + WANDER - self.robot.footprint
        round_ = [
            Obstacle("cylinder", tuple(puddle.get_position()[:2]), (puddle.radius,), margin=margin)
            for puddle in env.unwrapped.obstacles
        ]
        return round_ + WALLS

    def hazards(self, env: Any) -> list[Array]:
        return [np.asarray(puddle.get_position()) for puddle in env.unwrapped.obstacles]

    def goal(self, env: Any) -> Array:
        return np.asarray(env.unwrapped.task.goal.get_position())

    def steered(self, bearing: float) -> Array:
        """Forwards in a bow, but backwards to what lies behind."""
        ahead = abs(bearing) < 0.5 * math.pi
        turn = max(-1.0, min(2.0 * bearing, 1.0))
        return np.array([1.0, turn]) if ahead else np.array([-1.0, -turn])


class Seeded(gymnasium.Wrapper[Any, Any, Any, Any]):
    """Its environments draw from NumPy's own generator, whatever seed they are given."""

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        if seed is not None:
            np.random.seed(seed)  # noqa: NPY002 - it is this one that they use
        return self.env.reset(seed=seed, options=options)

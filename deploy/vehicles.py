"""Which simulator belongs to which robot: the one place to add a robot's."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np

from messaging.robots import GROUND, Robot
from messaging.shapes import WALL, Obstacle
from sim.envs import NavigationEnv
from sim.estimator import NoiseLevels
from sim.ground import GroundRobot
from sim.world import Arena, arena_kind

YARD = 50.0  # m to the walls of the place where data are recorded: farther than a trajectory can go


@dataclass(frozen=True)
class Conditions:
    """What may differ between the robot that was recorded and the one that drives."""

    noise: NoiseLevels = field(default_factory=NoiseLevels)
    payload_kg: float = 0.0
    floor_friction: float = 1.0

    def describe(self) -> dict[str, str]:
        """For metadata and printed results: every level with its value."""
        values = asdict(self.noise) | {"payload_kg": self.payload_kg, "floor_friction": self.floor_friction}
        return {name: f"{value:g}" for name, value in values.items()}


def environment(robot: Robot, arena: str, seed: int, conditions: Conditions | None = None) -> NavigationEnv:
    """A Gymnasium environment; `seed` sets its episodes apart from those of another seed."""
    if robot is not GROUND:
        raise ValueError(f"no simulator for {robot.name}")
    arena_kind(arena)
    c = conditions or Conditions()
    return NavigationEnv(
        robot, arena, noise=c.noise, seed_key=seed, payload_kg=c.payload_kg, floor_friction=c.floor_friction
    )


def vehicle_in_yard(robot: Robot, rng: np.random.Generator, conditions: Conditions) -> Any:
    """The bare vehicle with nothing near it, heading at random."""
    if robot is not GROUND:
        raise ValueError(f"no simulator for {robot.name}")
    walls = tuple(
        Obstacle(WALL, (-YARD * np.cos(yaw), -YARD * np.sin(yaw)), (), yaw) for yaw in np.arange(4) * (np.pi / 2)
    )
    start = (0.0, 0.0, float(rng.uniform(-np.pi, np.pi)))
    bounds = (-YARD, YARD)
    arena = Arena("yard", walls, start, (YARD / 2, 0.0), 0.25, 10**9, bounds)
    return GroundRobot(arena, rng, conditions.noise, conditions.payload_kg, conditions.floor_friction)

"""A base on three omnidirectional wheels: its simulator in MuJoCo, and its scripted policies."""

from __future__ import annotations

import math
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from brakeline.messaging.robot import Robot, robot_named
from brakeline.sim import scripted_policies
from brakeline.sim.arena import Arena
from brakeline.sim.ground_estimator import NoiseLevels
from brakeline.sim.planar_robot import PlanarRobot
from brakeline.sim.scripted_policies import bearing
from brakeline.sim.sim_conditions import Conditions
from brakeline.sim.vehicle import MakeVehicle

Array = NDArray[np.float64]

HERE = Path(__file__).parent
OMNI = robot_named(str(HERE / "omni.toml"))
MODEL = (HERE / "omni.xml").read_text()
HEIGHT = 0.02  # m, of the base's origin: the studs' radius
ARM = 0.15  # m from the middle to a wheel
SIDES = np.arange(3) * 2.0 * math.pi / 3.0  # rad, where the wheels are
RIMS = np.stack([-np.sin(SIDES), np.cos(SIDES), np.full(3, ARM)], axis=1)  # rim speeds from (ahead, aside, turn rate)


class Omni(PlanarRobot):
    """Input: speed ahead and to the left [m/s], turn rate [rad/s]."""

    def __init__(self, arena: Arena, rng: np.random.Generator, noise: NoiseLevels | None = None) -> None:
        super().__init__(OMNI, MODEL, HEIGHT, arena, rng, noise or NoiseLevels())

    def drive(self) -> None:
        self.data.ctrl[:] = RIMS @ self.input

    def speeds(self) -> Array:
        return np.array([*self.body_velocity(), self.data.qvel[5]])


def simulated(conditions: Conditions, tap: object = None) -> MakeVehicle:
    """Makes the task's vehicles: see `brakeline.messaging.task.Task.simulator`."""
    return partial(Omni, noise=conditions.noise)


def _towards(robot: Robot, angle: float, turn: float, share: float = 1.0) -> Array:
    """The fastest input in the direction of a bearing (rad), at that turn rate."""
    way = np.array([math.cos(angle), math.sin(angle)])
    top = share * robot.high()[:2] * way / np.abs(way).max()
    return np.asarray(np.clip([*top, turn], robot.low(), robot.high()))


class Greedy:
    """Full speed at the goal, whatever stands there."""

    def __init__(self, robot: Robot, rng: np.random.Generator) -> None:
        self._robot = robot

    def __call__(self, observation: NDArray[np.float32], info: dict[str, Any]) -> Array:
        return _towards(self._robot, bearing(info["state"], info["goal"]), 0.0)


class Adversary:
    """Full speed at the nearest obstacle, turning now this way, now that."""

    def __init__(self, robot: Robot, rng: np.random.Generator) -> None:
        self._robot, self._rng = robot, rng

    def __call__(self, observation: NDArray[np.float32], info: dict[str, Any]) -> Array:
        position = info["state"][:2]
        ways = info["arena"].shapes.towards(position)
        angle = bearing(info["state"], position + ways[np.argmin(np.linalg.norm(ways, axis=1))])
        return _towards(self._robot, angle, float(self._rng.choice([-1.0, 0.0, 1.0]) * self._robot.high()[2]))


class MapDriver(scripted_policies.GroundRoutePolicy):
    """Along the best way on the map, at half speed, without turning."""

    def _pursue(self, angle: float) -> Array:
        return _towards(self._robot, angle, 0.0, 0.5)

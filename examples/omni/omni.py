"""A base on three omnidirectional wheels: its simulator in MuJoCo, and its scripted policies."""

from __future__ import annotations

import math
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from brakeline import Robot, robot_named
from brakeline.sim.arena import Arena
from brakeline.sim.ground_estimator import NoiseLevels
from brakeline.sim.planar_robot import PlanarRobot
from brakeline.sim.scripted_policies import GroundRoutePolicy, ScriptedPolicy, bearing, vector_to_nearest
from brakeline.sim.sim_conditions import Conditions
from brakeline.sim.vehicle import MakeVehicle

Array = NDArray[np.float64]

HERE = Path(__file__).parent
OMNI = robot_named(str(HERE / "omni.toml"))
MODEL = (HERE / "omni.xml").read_text()
HEIGHT = 0.02  # m, of the base's origin: the radius of the studs
ARM = 0.15  # m from the middle to a wheel
SIDES = np.arange(3) * 2.0 * math.pi / 3.0  # rad, directions of the wheels
RIMS = np.stack([-np.sin(SIDES), np.cos(SIDES), np.full(3, ARM)], axis=1)  # rim speeds from (ahead, aside, turn rate)


class Omni(PlanarRobot):
    """A base. Its input: speed ahead and to the left [m/s], turn rate [rad/s]."""

    def __init__(self, arena: Arena, rng: np.random.Generator, noise: NoiseLevels | None = None) -> None:
        super().__init__(OMNI, MODEL, HEIGHT, arena, rng, noise or NoiseLevels())

    def drive(self) -> None:
        self.data.ctrl[:] = RIMS @ self.input

    def speeds(self) -> Array:
        return np.array([*self.body_velocity(), self.data.qvel[5]])


def simulated(conditions: Conditions, tap: object = None) -> MakeVehicle:
    """Return the function that makes the task's vehicles, see `brakeline.messaging.task.Task.simulator`."""
    conditions.check()  # refuses what it does not simulate
    return partial(Omni, noise=conditions.noise)


def _towards(robot: Robot, angle: float, turn: float, share: float = 1.0) -> Array:
    """Return the fastest input in the direction of a bearing [rad], at a share of full speed and a turn rate."""
    direction = np.array([math.cos(angle), math.sin(angle)])
    velocity = share * robot.high()[:2] * direction / np.abs(direction).max()
    return np.asarray(np.clip([*velocity, turn], robot.low(), robot.high()))


class Greedy(ScriptedPolicy):
    """Drive at the goal at full speed, whatever stands in between."""

    def __call__(self, observation: NDArray[np.float32], info: dict[str, Any]) -> Array:
        return _towards(self._robot, bearing(info["state"], info["goal"]), 0.0)


class Adversary(ScriptedPolicy):
    """Drive at the nearest obstacle at full speed, with a random turn rate."""

    def __call__(self, observation: NDArray[np.float32], info: dict[str, Any]) -> Array:
        angle = bearing(info["state"], info["state"][:2] + vector_to_nearest(info))
        return _towards(self._robot, angle, float(self._rng.choice([-1.0, 0.0, 1.0]) * self._robot.high()[2]))


class MapDriver(GroundRoutePolicy):
    """Follow the best path on the map at half speed, without turning."""

    def _pursue(self, angle: float) -> Array:
        return _towards(self._robot, angle, 0.0, 0.5)

"""A car with Ackermann steering: its simulator in MuJoCo, and its scripted policies."""

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
from brakeline.sim.scripted_policies import bearing, bounded
from brakeline.sim.sim_conditions import Conditions
from brakeline.sim.vehicle import MakeVehicle

Array = NDArray[np.float64]

HERE = Path(__file__).parent
CAR = robot_named(str(HERE / "car.toml"))
MODEL = (HERE / "car.xml").read_text()
WHEEL_RADIUS = 0.05  # m
WHEELBASE = 0.26  # m
TRACK = 0.22  # m
STEERING = slice(9, 12, 2)  # in qpos: the knuckles' angles; after each comes its wheel's


class Car(PlanarRobot):
    """Input: speed of the rear axle [m/s], steering angle [rad] of a wheel in the middle of the front axle."""

    def __init__(self, arena: Arena, rng: np.random.Generator, noise: NoiseLevels | None = None) -> None:
        super().__init__(CAR, MODEL, WHEEL_RADIUS, arena, rng, noise or NoiseLevels())

    def drive(self) -> None:
        """Each knuckle by Ackermann's rule, so that all wheels roll about one point; the rear wheels likewise."""
        speed, steering = self.input
        curvature = math.tan(steering) / WHEELBASE
        turn = 0.5 * TRACK * math.tan(self._steering()) / WHEELBASE  # of the wheels as they stand
        left, right = (math.atan(WHEELBASE * curvature / (1.0 + s * 0.5 * TRACK * curvature)) for s in (-1.0, 1.0))
        self.data.ctrl[:] = (1.0 - turn) * speed / WHEEL_RADIUS, (1.0 + turn) * speed / WHEEL_RADIUS, left, right

    def speeds(self) -> Array:
        return np.array([self.body_velocity()[0], self._steering()])

    def _steering(self) -> float:
        """The angle in the middle of the front axle that both knuckles' angles come to, rad."""
        left, right = self.data.qpos[STEERING].tolist()
        return math.atan(2.0 / (1.0 / _tan(left) + 1.0 / _tan(right)))


def _tan(angle: float) -> float:
    """tan, but never 0."""
    return math.tan(angle) or 1e-12


def simulated(conditions: Conditions, tap: object = None) -> MakeVehicle:
    """Makes the task's vehicles: see `brakeline.messaging.task.Task.simulator`."""
    return partial(Car, noise=conditions.noise)


def _towards(robot: Robot, angle: float, share: float = 1.0) -> Array:
    """Drive at a bearing (rad), forwards or backwards, whichever end is nearer to it, at a share of full speed."""
    ahead = abs(angle) <= 0.5 * math.pi
    off = angle if ahead else math.remainder(angle + math.pi, 2.0 * math.pi)
    top = share * float(robot.high()[0])
    return bounded(robot, top if ahead else -top, off if ahead else -off)


class Greedy:
    """Full speed at the goal, whatever stands there."""

    def __init__(self, robot: Robot, rng: np.random.Generator) -> None:
        self._robot = robot

    def __call__(self, observation: NDArray[np.float32], info: dict[str, Any]) -> Array:
        return _towards(self._robot, bearing(info["state"], info["goal"]))


class Adversary:
    """Full speed at the nearest obstacle, forwards or backwards."""

    def __init__(self, robot: Robot, rng: np.random.Generator) -> None:
        self._robot = robot

    def __call__(self, observation: NDArray[np.float32], info: dict[str, Any]) -> Array:
        position = info["state"][:2]
        ways = info["arena"].shapes.towards(position)
        return _towards(self._robot, bearing(info["state"], position + ways[np.argmin(np.linalg.norm(ways, axis=1))]))


class MapDriver(scripted_policies.GroundRoutePolicy):
    """Along the best way on the map, forwards or backwards."""

    def _pursue(self, angle: float) -> Array:
        return _towards(self._robot, angle, 0.8)

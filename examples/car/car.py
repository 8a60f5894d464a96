"""A car with Ackermann steering: its simulator in MuJoCo, and its scripted policies."""

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
from brakeline.sim.scripted_policies import GroundRoutePolicy, ScriptedPolicy, bearing, bounded, vector_to_nearest
from brakeline.sim.sim_conditions import Conditions
from brakeline.sim.vehicle import MakeVehicle

Array = NDArray[np.float64]

HERE = Path(__file__).parent
CAR = robot_named(str(HERE / "car.toml"))
MODEL = (HERE / "car.xml").read_text()
WHEEL_RADIUS = 0.05  # m
WHEELBASE = 0.26  # m
TRACK = 0.22  # m
STEERING = slice(9, 12, 2)  # of qpos: the angles of the two knuckles, each before the angle of its wheel


class Car(PlanarRobot):
    """A car. Its input: speed of the rear axle [m/s], steering angle [rad] in the middle of the front axle."""

    def __init__(self, arena: Arena, rng: np.random.Generator, noise: NoiseLevels | None = None) -> None:
        super().__init__(CAR, MODEL, WHEEL_RADIUS, arena, rng, noise or NoiseLevels())

    def drive(self) -> None:
        """Set knuckles and rear wheels by Ackermann's rule: all wheels roll about one point."""
        speed, steering = self.input
        curvature = math.tan(steering) / WHEELBASE
        turn = 0.5 * TRACK * math.tan(self._steering()) / WHEELBASE  # at the present angles
        left, right = (math.atan(WHEELBASE * curvature / (1.0 + s * 0.5 * TRACK * curvature)) for s in (-1.0, 1.0))
        self.data.ctrl[:] = (1.0 - turn) * speed / WHEEL_RADIUS, (1.0 + turn) * speed / WHEEL_RADIUS, left, right

    def speeds(self) -> Array:
        return np.array([self.body_velocity()[0], self._steering()])

    def _steering(self) -> float:
        """Return the angle [rad] in the middle of the front axle that corresponds to both knuckles' angles."""
        left, right = self.data.qpos[STEERING].tolist()
        return math.atan(2.0 / (1.0 / _tan(left) + 1.0 / _tan(right)))


def _tan(angle: float) -> float:
    """Return the tangent, but never 0."""
    return math.tan(angle) or 1e-12


def simulated(conditions: Conditions, tap: object = None) -> MakeVehicle:
    """Return the function that makes the task's vehicles, see `brakeline.messaging.task.Task.simulator`."""
    conditions.check()  # refuses what it does not simulate
    return partial(Car, noise=conditions.noise)


def _towards(robot: Robot, angle: float, share: float = 1.0) -> Array:
    """Return the input that drives towards a bearing [rad] at a share of full speed, with the nearer end first."""
    ahead = abs(angle) <= 0.5 * math.pi
    off = angle if ahead else math.remainder(angle + math.pi, 2.0 * math.pi)
    top = share * float(robot.high()[0])
    return bounded(robot, top if ahead else -top, off if ahead else -off)


class Greedy(ScriptedPolicy):
    """Drive at the goal at full speed, whatever stands in between."""

    def __call__(self, observation: NDArray[np.float32], info: dict[str, Any]) -> Array:
        return _towards(self._robot, bearing(info["state"], info["goal"]))


class Adversary(ScriptedPolicy):
    """Drive at the nearest obstacle at full speed, forwards or backwards."""

    def __call__(self, observation: NDArray[np.float32], info: dict[str, Any]) -> Array:
        return _towards(self._robot, bearing(info["state"], info["state"][:2] + vector_to_nearest(info)))


class MapDriver(GroundRoutePolicy):
    """Follow the best path on the map, forwards or backwards."""

    def _pursue(self, angle: float) -> Array:
        return _towards(self._robot, angle, 0.8)

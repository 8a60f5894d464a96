"""What makes quadrotors: behind their own autopilots in memory, or behind a real PX4 (`simulator` in a task's file)."""

from __future__ import annotations

import os
from functools import partial
from pathlib import Path

import numpy as np

from actors.flying import MavlinkVehicle
from actors.frames import Tap
from actors.px4 import QUIET, Px4Flight, Px4Vehicle
from messaging.tasks import RobotWithTask, robot_with_task
from sim.arenas import draw_arena
from sim.autopilot.endpoint import Autopilot
from sim.autopilot.rules import SETPOINT_TIMEOUT
from sim.autopilot.sensors import SensorNoise
from sim.conditions import Conditions
from sim.flight_estimator import QuadrotorNoise
from sim.quadrotor import QUADROTOR, Quadrotor
from sim.vehicle import MakeVehicle
from sim.wind import Wind
from sim.world import Arena


def embedded(conditions: Conditions, tap: Tap | None = None) -> MakeVehicle:
    """Makes quadrotors behind their own autopilots."""
    return partial(embedded_quadrotor, noise=conditions.flight_noise, wind=conditions.wind, tap=tap)


def embedded_quadrotor(
    arena: Arena,
    rng: np.random.Generator,
    noise: QuadrotorNoise | None = None,
    wind: Wind | None = None,
    rules: str = "px4",
    *,
    tap: Tap | None = None,
) -> MavlinkVehicle:
    """A quadrotor behind its own autopilot, over MAVLink in memory.

    It brakes by itself when a setpoint is overdue by a period. tap: is called with every MAVLink frame.
    """
    parameters = {SETPOINT_TIMEOUT[rules]: QUADROTOR.period}
    autopilot = Autopilot(Quadrotor(arena, rng, noise, wind), rules, parameters=parameters, quiet=True)
    return MavlinkVehicle(autopilot, QUADROTOR, tap)


def behind_px4(conditions: Conditions, tap: Tap | None = None) -> MakeVehicle:
    """Makes quadrotors behind the real PX4 in the folder `$BRAKELINE_PX4`: one process flies all their episodes.

    Raises:
        ValueError: there is no such folder.
    """
    folder = os.environ.get("BRAKELINE_PX4")
    if not folder:
        raise ValueError("set BRAKELINE_PX4 to the folder of a PX4 that was built for SITL")
    flight = Px4Flight(Path(folder), SensorNoise(scale=conditions.flight_noise.scale), tap=tap)

    def make(arena: Arena, rng: np.random.Generator) -> Px4Vehicle:
        return Px4Vehicle(flight, Quadrotor(arena, rng, QUIET, conditions.wind), QUADROTOR)

    return make


def flight_arena(name: str, seed: int, robot: RobotWithTask | None = None) -> Arena:
    """The one arena of a flight in real time: the autopilot's world, and the actor's map."""
    return draw_arena(name, np.random.default_rng(seed), robot or robot_with_task("quadrotor"))

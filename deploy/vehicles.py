"""A task's vehicles and environments, made."""

from __future__ import annotations

import os
from functools import lru_cache, partial
from pathlib import Path

import numpy as np

from actors.flying import MavlinkVehicle
from actors.frames import Tap
from actors.px4 import QUIET, Px4Flight, Px4Vehicle
from messaging.robots import Robot
from messaging.tasks import task_of
from sim.arenas import arena_kind, draw_arena
from sim.autopilot.endpoint import Autopilot
from sim.autopilot.rules import SETPOINT_TIMEOUT
from sim.autopilot.sensors import SensorNoise
from sim.conditions import Conditions
from sim.envs import NavigationEnv
from sim.fleet import FleetEnv
from sim.flight_estimator import QuadrotorNoise
from sim.late import late
from sim.quadrotor import QUADROTOR, Quadrotor
from sim.vehicle import MakeVehicle, Vehicle
from sim.wind import Wind
from sim.world import Arena, closing, room_bounds

YARD = {2: 50.0, 3: 500.0}  # m to the walls of the place where data are recorded: farther than a trajectory can go


def factory(robot: Robot, conditions: Conditions, tap: Tap | None = None) -> MakeVehicle:
    """What makes a vehicle of that kind under these conditions; tap: see `environment`.

    Raises:
        UnknownTask: there is none.
    """
    if robot.late:
        return late(factory(robot.in_lockstep(), conditions, tap), robot)
    task = task_of(robot)
    make: MakeVehicle = task.code(task.simulator)(conditions, tap)
    return make


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


def flight_arena(name: str, seed: int, robot: Robot = QUADROTOR) -> Arena:
    """The one arena of a flight in real time: the autopilot's world, and the actor's map."""
    return draw_arena(name, np.random.default_rng(seed), robot)


def environment(
    robot: Robot, arena: str, seed: int, conditions: Conditions | None = None, *, tap: Tap | None = None
) -> NavigationEnv:
    """A Gymnasium environment; `seed` sets its episodes apart from those of another seed; tap: is called with every
    MAVLink frame of a robot that has any.

    Raises:
        UnknownTask: the robot has none; UnknownArena: no such arena for it.
    """
    c = conditions or Conditions()
    make = factory(robot, c, tap)
    arena_kind(robot, arena)
    noise = c.lidar_noise(robot.position_dim == 3)
    return NavigationEnv(robot, arena, make, noise, seed_key=seed, perception=c.perception)


def fleet_world(robot: Robot, arena: str, size: int, seed: int, conditions: Conditions | None = None) -> FleetEnv:
    """A world of several robots: see there."""
    return FleetEnv(robot, arena, size, seed, conditions)


def vehicle_in_yard(robot: Robot, rng: np.random.Generator, conditions: Conditions) -> Vehicle:
    """The bare vehicle with nothing near it, heading at random."""
    yard = YARD[robot.position_dim]
    height = None if robot.position_dim == 2 else 2.0 * yard
    start = (0.0, 0.0, float(rng.uniform(-np.pi, np.pi)) if height is None else yard)
    goal = (0.5 * yard, 0.0) if height is None else (0.5 * yard, 0.0, yard)
    arena = Arena("yard", closing(yard, height), start, goal, 0.25, 10**9, room_bounds(yard, height))
    return _maker(robot, conditions)(arena, rng)


@lru_cache(maxsize=1)
def _maker(robot: Robot, conditions: Conditions) -> MakeVehicle:
    """The same for one trajectory after the other: what starts a real autopilot starts it once."""
    return factory(robot, conditions)

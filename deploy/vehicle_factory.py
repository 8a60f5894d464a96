"""A task's vehicles and environments, made.

What makes a vehicle is imported when one is made: without an autopilot, a ground robot's process starts sooner.
"""

from __future__ import annotations

from functools import lru_cache
from typing import TYPE_CHECKING

import numpy as np

from brakeline.messaging.task import RobotWithTask
from brakeline.sim.arena import Arena, room_boundary, room_bounds
from brakeline.sim.arena_generator import arena_kind
from brakeline.sim.delayed_vehicle import delayed
from brakeline.sim.navigation_env import NavigationEnv
from brakeline.sim.sim_conditions import Conditions
from brakeline.sim.vehicle import MakeVehicle, Vehicle

if TYPE_CHECKING:
    from brakeline.actors.mavlink.frame_log import FrameTap
    from brakeline.sim.shared_world import FleetEnv

YARD = {2: 50.0, 3: 500.0}  # m to the walls of the place where data are recorded: farther than a trajectory can go


def factory(robot: RobotWithTask, conditions: Conditions, tap: FrameTap | None = None) -> MakeVehicle:
    """What makes a vehicle of that kind under these conditions; tap: see `environment`.

    Raises:
        UnknownTask: there is none.
    """
    if robot.late:
        return delayed(factory(robot.in_lockstep(), conditions, tap), robot)
    task = robot.task
    make: MakeVehicle = task.code(task.simulator)(conditions, tap)
    return make


def environment(
    robot: RobotWithTask, arena: str, seed: int, conditions: Conditions | None = None, *, tap: FrameTap | None = None
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


def fleet_world(
    robot: RobotWithTask, arena: str, size: int, seed: int, conditions: Conditions | None = None
) -> FleetEnv:
    """A world of several robots: see there."""
    from brakeline.sim.shared_world import FleetEnv

    return FleetEnv(robot, arena, size, seed, conditions)


def vehicle_in_yard(robot: RobotWithTask, rng: np.random.Generator, conditions: Conditions) -> Vehicle:
    """The bare vehicle with nothing near it, heading at random."""
    yard = YARD[robot.position_dim]
    height = None if robot.position_dim == 2 else 2.0 * yard
    start = (0.0, 0.0, float(rng.uniform(-np.pi, np.pi)) if height is None else yard)
    goal = (0.5 * yard, 0.0) if height is None else (0.5 * yard, 0.0, yard)
    arena = Arena("yard", room_boundary(yard, height), start, goal, 0.25, 10**9, room_bounds(yard, height))
    return _maker(robot, conditions)(arena, rng)


@lru_cache(maxsize=1)
def _maker(robot: RobotWithTask, conditions: Conditions) -> MakeVehicle:
    """The same for one trajectory after the other: what starts a real autopilot starts it once."""
    return factory(robot, conditions)

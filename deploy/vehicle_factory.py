"""Make the vehicles and environments of a task.

The module imports a simulator only when it makes a vehicle: the process of a ground robot starts sooner without an
autopilot.
"""

from __future__ import annotations

from functools import lru_cache
from typing import TYPE_CHECKING

import numpy as np

from brakeline.messaging.task import RobotWithTask, arena_kind
from brakeline.sim.arena import Arena, room_boundary, room_bounds
from brakeline.sim.arena_generator import draw_arena
from brakeline.sim.delayed_vehicle import simulated_vehicle
from brakeline.sim.navigation_env import DrawArena, NavigationEnv
from brakeline.sim.sim_conditions import Conditions
from brakeline.sim.vehicle import Vehicle

if TYPE_CHECKING:
    from brakeline.actors.mavlink.frame_log import FrameTap
    from brakeline.sim.shared_world import FleetEnv

# m, distance of the walls of an empty arena in the plane and in space: no recorded trajectory gets that far
EMPTY_ARENA_SIZE = {2: 50.0, 3: 500.0}


def environment(
    robot: RobotWithTask,
    arena: str,
    seed: int,
    conditions: Conditions | None = None,
    *,
    tap: FrameTap | None = None,
    draw: DrawArena = draw_arena,
) -> NavigationEnv:
    """Return the Gymnasium environment of a robot in an arena.

    Args:
        seed: separates its episodes from those of another seed.
        conditions: differences from the recorded robot; None: none.
        tap: is called with each MAVLink frame of a robot that has any.
        draw: draws the arena of an episode.

    Raises:
        UnknownTask: the robot has no simulator.
        UnknownName: the robot has no such arena.
    """
    conditions = conditions or Conditions()
    make = simulated_vehicle(robot, conditions, tap)
    arena_kind(robot, arena)
    return NavigationEnv(robot, arena, make, conditions=conditions, seed_key=seed, draw=draw)


def fleet_world(
    robot: RobotWithTask, arena: str, size: int, seed: int, conditions: Conditions | None = None
) -> FleetEnv:
    """Return a world that `size` robots share."""
    from brakeline.sim.shared_world import FleetEnv

    return FleetEnv(robot, arena, size, seed, conditions)


def empty_arena(robot: RobotWithTask, position: tuple[float, float] = (0.0, 0.0), heading: float = 0.0) -> Arena:
    """Return an arena with walls far away and nothing else, its goal out of reach.

    Args:
        position: start in the plane [m]; in space at half the height of the arena.
        heading: of the start, in the plane [rad].
    """
    size = EMPTY_ARENA_SIZE[robot.position_dim]
    height = None if robot.position_dim == 2 else 2.0 * size
    start = (*position, heading if height is None else size)
    goal = (0.9 * size, 0.9 * size, *(() if height is None else (size,)))
    return Arena("yard", room_boundary(size, height), start, goal, 0.25, 10**9, room_bounds(size, height))


def empty_arena_at_random(robot: RobotWithTask, rng: np.random.Generator) -> Arena:
    """Return an empty arena; in the plane, the start has a random heading."""
    return empty_arena(robot, heading=float(rng.uniform(-np.pi, np.pi)) if robot.position_dim == 2 else 0.0)


def vehicle_in_empty_arena(robot: RobotWithTask, rng: np.random.Generator, conditions: Conditions) -> Vehicle:
    """Return a vehicle with nothing near it; in the plane with a random heading."""
    return _maker(robot, conditions)(empty_arena_at_random(robot, rng), rng)


_maker = lru_cache(maxsize=1)(simulated_vehicle)  # the same one for all trajectories: a real autopilot starts once

"""Make quadrotors behind simulated autopilots in memory, or behind a real PX4 (`simulator` in a task file)."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np

from brakeline.actors.mavlink.frame_log import FrameTap
from brakeline.actors.mavlink.lockstep_quadrotor import LockstepQuadrotor
from brakeline.actors.mavlink.px4_lockstep import QUIET, Px4Flight, Px4Vehicle
from brakeline.messaging.robot import Robot
from brakeline.messaging.task import RobotWithTask, robot_with_task
from brakeline.sim.arena import Arena
from brakeline.sim.arena_generator import draw_arena
from brakeline.sim.autopilot.autopilot_rules import SETPOINT_TIMEOUT
from brakeline.sim.autopilot.endpoint import Autopilot
from brakeline.sim.delayed_vehicle import check_described
from brakeline.sim.quadrotor import QUADROTOR, Quadrotor
from brakeline.sim.sim_conditions import Conditions, SensorNoise
from brakeline.sim.vehicle import MakeVehicle


def embedded(conditions: Conditions, tap: FrameTap | None = None, robot: Robot = QUADROTOR) -> MakeVehicle:
    """Return the function that makes quadrotors behind simulated autopilots.

    tap: is called with each MAVLink frame. Raises ValueError as `changes_of`, and Mismatch as `check_described`.
    """
    check_described(robot, QUADROTOR)
    noise, wind, changes = conditions.flight_noise, conditions.wind, changes_of(conditions)
    # The autopilot brakes when a setpoint is late by one control period.
    parameters = {SETPOINT_TIMEOUT["px4"]: QUADROTOR.period}

    def make(arena: Arena, rng: np.random.Generator) -> LockstepQuadrotor:
        vehicle = Quadrotor(arena, rng, noise, wind, changes=changes)
        return LockstepQuadrotor(Autopilot(vehicle, "px4", parameters=parameters, quiet=True), QUADROTOR, tap)

    return make


def changes_of(conditions: Conditions) -> dict[str, float]:
    """Return what `Quadrotor.alter` has to change for these conditions; compiled code flies a quadrotor without any.

    Raises:
        ValueError: the conditions have something that no quadrotor has.
    """
    names = ("payload_kg", "weak_motor")
    conditions.check(*names, "wind")
    return {name: getattr(conditions, name) for name in names if name in conditions.unusual}


def behind_px4(conditions: Conditions, tap: FrameTap | None = None, robot: Robot = QUADROTOR) -> MakeVehicle:
    """Return the function that makes quadrotors behind the real PX4 in `$BRAKELINE_PX4`. It flies all episodes.

    Raises:
        ValueError: the variable is not set, or as `changes_of`. Mismatch: as `check_described`.
    """
    check_described(robot, QUADROTOR)
    changes = changes_of(conditions)
    folder = os.environ.get("BRAKELINE_PX4")
    if not folder:
        raise ValueError("set BRAKELINE_PX4 to the folder of a PX4 that was built for SITL")
    flight = Px4Flight(Path(folder), SensorNoise(scale=conditions.flight_noise.scale), tap=tap)

    def make(arena: Arena, rng: np.random.Generator) -> Px4Vehicle:
        return Px4Vehicle(flight, Quadrotor(arena, rng, QUIET, conditions.wind, changes=changes), QUADROTOR)

    return make


def flight_arena(name: str, seed: int, robot: RobotWithTask | None = None) -> Arena:
    """Return the arena of a flight in real time: the world of the autopilot, and the map of the actor."""
    return draw_arena(name, np.random.default_rng(seed), robot or robot_with_task("quadrotor"))

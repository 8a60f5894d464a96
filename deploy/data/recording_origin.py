"""State where a simulated recording comes from, and recognise a recording of an older simulator."""

from __future__ import annotations

from collections.abc import Mapping

from brakeline.messaging.robot import Robot
from brakeline.messaging.task import RobotWithTask
from brakeline.safety.model.dataset import RESTLESS
from brakeline.sim.sim_conditions import Conditions

ORIGIN = "collect"
VERSION = "simulator_version"


def origin(robot: RobotWithTask, seed: int, conditions: Conditions, restless: int) -> dict[str, str]:
    """Return the `about` entries of a recording: conditions, seed, origin, and how many trajectories are restless."""
    recorded = {"seed": str(seed), "origin": ORIGIN, VERSION: str(robot.task.simulator_version)}
    return conditions.describe() | recorded | {RESTLESS: str(restless)}


def simulator_changed(robot: Robot, about: Mapping[str, str]) -> bool:
    """Return whether an entry `about` names another version of the robot's simulator. Without a version, it means 1."""
    return isinstance(robot, RobotWithTask) and about.get(VERSION, "1") != str(robot.task.simulator_version)


def outdated(robot: Robot, about: Mapping[str, str]) -> bool:
    """Return whether data, or a model set made from them, were recorded in another version of the robot's simulator."""
    return about.get("origin") == ORIGIN and simulator_changed(robot, about)

"""Say which robots and arenas a batch simulates.

This module imports no simulator, because the launcher asks it, too.
"""

from __future__ import annotations

from brakeline.errors import NoBatch
from brakeline.messaging.robot import robot_named
from brakeline.messaging.task import RobotWithTask, arena_kind
from brakeline.sim.sim_conditions import Conditions

# The robots that a batch simulates, with the code of their simulators.
SIMULATED = (
    (robot_named("ground").layout(), "brakeline.sim.ground_robot:simulated"),
    (robot_named("quadrotor").layout(), "brakeline.deploy.quadrotor_vehicles:embedded"),
)
# The code of the observations of batches, by the robots' dimension.
OBSERVED = {2: "brakeline.sim.observations:GroundObservation", 3: "brakeline.sim.observations:QuadrotorObservation"}
ADVICE = "use NavigationEnv, or train without --backend batch"


def check_vehicles(robot: RobotWithTask, conditions: Conditions) -> None:
    """Check that many robots of this kind can be simulated at once.

    Raises:
        NoBatch: they can only be simulated one by one.
        ValueError: no simulator of this robot has such conditions.
    """
    if conditions.learned:
        raise NoBatch(f"a robot that its model set simulates (--learned) is not simulated in batches: {ADVICE}")
    if (robot.layout(), robot.task.simulator) not in SIMULATED:
        raise NoBatch(f"{robot.name} with the task {robot.task.name} is not simulated in batches: {ADVICE}")
    if robot.position_dim == 3 and not conditions.wind.calm:
        raise NoBatch(f"a batch of quadrotors flies in calm air (--wind 0 --gust 0): {ADVICE}")
    if robot.position_dim == 3 and {"payload_kg", "weak_motor"} & {*conditions.unusual}:
        raise NoBatch(f"a batch of quadrotors has no payload and no weak motors: {ADVICE}")
    if robot.position_dim == 3:
        conditions.check()


def check_batch(robot: RobotWithTask, arena: str, conditions: Conditions) -> None:
    """Check that many robots can be simulated at once.

    Raises:
        NoBatch: this robot, arena or perception can only be simulated one by one.
        UnknownName: the robot has no arena of this name.
        ValueError: no simulator of this robot has such conditions.
    """
    kind = arena_kind(robot, arena)
    check_vehicles(robot, conditions)
    if robot.task.senses != OBSERVED[robot.position_dim]:
        raise NoBatch(f"{robot.name} with the task {robot.task.name} is not observed in batches: {ADVICE}")
    if kind.movers is not None or kind.ring is not None:
        raise NoBatch(f"the arena {arena} has moving obstacles or other robots, which no batch simulates: {ADVICE}")
    if conditions.perception.kind != "map":
        raise NoBatch(f"a batch perceives by the map, not by scans (--perception map): {ADVICE}")

"""Make the vehicles of a batch: many robots of one kind."""

from __future__ import annotations

from brakeline.errors import NoBatch
from brakeline.messaging.task import ArenaKind, RobotWithTask
from brakeline.sim.batch.ground_batch import GroundBatch
from brakeline.sim.batch.normal_streams import NormalStreams
from brakeline.sim.batch.quadrotor_batch import QuadrotorBatch
from brakeline.sim.batch.vehicle_batch import VehicleBatch
from brakeline.sim.ground_robot import GROUND
from brakeline.sim.quadrotor import QUADROTOR
from brakeline.sim.sim_conditions import Conditions

# The robots that a batch simulates, with the code of their simulators.
SIMULATED = (
    (GROUND.layout(), "brakeline.sim.ground_robot:simulated"),
    (QUADROTOR.layout(), "brakeline.deploy.quadrotor_vehicles:embedded"),
)
ADVICE = "use NavigationEnv, or train without --backend batch"


def check_vehicles(robot: RobotWithTask, conditions: Conditions) -> None:
    """Check that many robots of this kind can be simulated at once. Raises NoBatch if they can't."""
    if (robot.layout(), robot.task.simulator) not in SIMULATED:
        raise NoBatch(f"{robot.name} with the task {robot.task.name} is not simulated in batches: {ADVICE}")
    if robot.position_dim == 3 and not conditions.wind.calm:
        raise NoBatch(f"a batch of quadrotors flies in calm air (--wind 0 --gust 0): {ADVICE}")
    if robot.position_dim == 3 and {"payload_kg", "weak_motor"} & {*conditions.unusual}:
        raise NoBatch(f"a batch of quadrotors has no payload and no weak motors: {ADVICE}")


def vehicle_batch(
    robot: RobotWithTask, size: int, kind: ArenaKind, conditions: Conditions, threads: int, streams: NormalStreams
) -> VehicleBatch:
    """Return `size` robots, each for an arena of this kind. threads: for the physics. streams: of all sensor errors."""
    if robot.position_dim == 3:
        return QuadrotorBatch(size, kind, conditions, streams)
    return GroundBatch(size, kind, conditions, threads if threads > 1 else 0, streams)

"""Make the vehicles of a batch: many robots of one kind."""

from __future__ import annotations

from brakeline.messaging.task import ArenaKind, RobotWithTask
from brakeline.sim.batch.ground_batch import GroundBatch
from brakeline.sim.batch.normal_streams import NormalStreams
from brakeline.sim.batch.quadrotor_batch import QuadrotorBatch
from brakeline.sim.batch.vehicle_batch import VehicleBatch
from brakeline.sim.sim_conditions import Conditions


def vehicle_batch(
    robot: RobotWithTask, size: int, kind: ArenaKind, conditions: Conditions, threads: int, streams: NormalStreams
) -> VehicleBatch:
    """Return `size` robots, each for an arena of this kind. threads: for the physics. streams: of all sensor errors."""
    if robot.position_dim == 3:
        return QuadrotorBatch(size, kind, conditions, streams)
    return GroundBatch(size, kind, conditions, threads if threads > 1 else 0, streams)

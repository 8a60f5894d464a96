"""The space within reach of a robot, as its request describes it (docs/method.md §3, §8-§10)."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cache

import numpy as np
from numpy.typing import NDArray

from brakeline.messaging.moving_obstacles import MovingObstacles
from brakeline.messaging.obstacle import Shapes
from brakeline.messaging.robot import Array, Robot
from brakeline.messaging.scan import Scan
from brakeline.safety.filter.kernels import shape_kernels
from brakeline.safety.filter.recovery import escape_direction
from brakeline.safety.filter.request import Request
from brakeline.safety.filter.reservation import OtherReservations
from brakeline.safety.perception.occluded_regions import OccludedRegions
from brakeline.safety.perception.scan_free_space import OccupiedCells, occupied_cells


@dataclass(frozen=True)
class LocalMap:
    """What a request says about the space within reach of a robot, in the world."""

    # start (d,), heading [rad]: measured pose
    start: Array
    heading: float
    turn: Array  # (d, d): rotation from the robot's frame to the world
    near: Shapes  # obstacles within reach
    beyond: float  # [m]: the distance below which the request names no further obstacle, at most the sensor's range
    moving: MovingObstacles | None = None  # moving obstacles that may come within reach
    unseen: OccupiedCells | OccludedRegions | None = None  # space that a scan does not show to be free
    other_reservations: OtherReservations | None = None  # those of other robots
    widening: float = 1.0  # factor on every set of a plan (docs/method.md §15)
    # factors on the set of the next state: on the coordinates that decide what is verified, and on the others
    asked_widening: float = 1.0
    state_widening: float = 1.0

    def state_factors(self, decide: NDArray[np.bool_]) -> Array:
        """Return the factors (n,) on the set of the next state. decide (n,): see `deciding_coordinates`."""
        return np.where(decide, self.asked_widening, self.state_widening)

    @property
    def parked(self) -> LocalMap:
        """Return the map without moving obstacles: a standing robot need not avoid them (passive safety, §8)."""
        unseen = None if self.unseen is not None and self.unseen.speed > 0.0 else self.unseen
        return replace(self, moving=None, unseen=unseen)

    @property
    def away(self) -> Array | None:
        """The direction (d,), world, away from the nearest obstacle; None if no near obstacle has a direction."""
        ways = [escape_direction(self.near, self.start)[None]] if len(self.near) else []
        if isinstance(self.unseen, OccupiedCells):
            ways.append(self.start - self.unseen.corners.reshape(-1, len(self.start)))
        directions = np.concatenate(ways or [np.zeros((0, len(self.start)))])
        return directions[np.argmin(np.einsum("nd,nd->n", directions, directions))] if len(directions) else None

    @property
    def empty(self) -> bool:
        return not len(self.near) and self.moving is None and self.unseen is None and self.other_reservations is None


def local_map(
    robot: Robot, request: Request, widening: float, reach: float, turn: Array, occluded: OccludedRegions | None
) -> LocalMap:
    """Return the map of a request.

    Args:
        robot: the robot. request: its request.
        widening: factor on every set of a plan.
        reach [m]: radius of the map. turn (d, d): rotation from the robot's frame to the world.
        occluded: the shadows of the request's range image, if it has one.
    """
    d, near, beyond = robot.position_dim, request.obstacles, robot.sight
    start, whole_plan = np.ascontiguousarray(request.state[:d]), robot.horizon * robot.period
    heading = float(request.state[robot.heading]) if robot.heading is not None else 0.0
    if len(near):
        away = shape_kernels.distances(*near.parts, start) - np.maximum(near.margin, robot.least_margin)
        beyond, counts, number = shape_kernels.parted(away, beyond, reach)
        if number < len(near):
            near = near.take(counts) if number else _nothing(d)
    moving = request.movers
    if moving is not None:
        nearest = moving.least_distance(start, whole_plan, robot.least_margin)
        beyond, counts, number = shape_kernels.parted(nearest, beyond, reach)
        moving = moving.take(counts) if number else None
    other_reservations = request.other_reservations
    if other_reservations is not None:
        beyond, counts, number = shape_kernels.parted(other_reservations.nearest(start), beyond, reach)
        other_reservations = other_reservations.take(counts) if number else None
    unseen: OccupiedCells | OccludedRegions | None = occluded
    if isinstance(request.scan, Scan):
        unseen = _unseen(request.scan, start, reach, whole_plan)
    factors = widening, request.widening, max(request.widening, request.state_widening)
    return LocalMap(start, heading, turn, near, beyond, moving, unseen, other_reservations, *factors)


@cache
def _nothing(dim: int) -> Shapes:
    """Return no obstacles."""
    return Shapes.of((), dim)


def _unseen(scan: Scan, start: Array, reach: float, whole_plan: float) -> OccupiedCells | None:
    """Return the cells that a scan does not show to be free, within reach or able to come there during a plan [s]."""
    within = reach + scan.speed * (scan.age + whole_plan)
    within += float(np.linalg.norm(scan.sensor()[0] - start)) + scan.sensor_error
    cells = occupied_cells(scan, within + scan.heading_error * within)
    return cells if len(cells) else None

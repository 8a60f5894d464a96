"""The constraint that blocks a proposal: the half-space that its tube comes nearest to, or violates most."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from brakeline.messaging.moving_obstacles import MovingObstacles
from brakeline.messaging.obstacle import Shapes
from brakeline.messaging.robot import Array, Robot
from brakeline.messaging.value_equality import ComparedByValue
from brakeline.safety.filter.halfspaces import rows_per_obstacle
from brakeline.safety.filter.moving_halfspaces import swept_half_spaces
from brakeline.safety.filter.reservation import OtherReservations
from brakeline.safety.perception.occluded_regions import OccludedRegions
from brakeline.safety.perception.scan_free_space import OccupiedCells
from brakeline.safety.perception.scan_free_space import half_spaces as unseen_half_spaces

UNSEEN, SIGHT, ROBOT = "unseen", "sight", "robot"


def why_not_allowed(margin: float, of_space: bool = True, too_long_for: float = np.inf) -> str:
    """Return a sentence that says why a proposal is not allowed.

    Args:
        margin: the distance of its tube to the edge of free space [m], or to a limit, in the limit's unit. It is
            negative if the tube ends beyond the edge.
        of_space: true for the edge of free space, false for a limit.
        too_long_for: how far the filter looks ahead [m], if the tube leads farther; otherwise infinity.
    """
    unit, edge = ("m", "the free space's edge") if of_space else ("(in its own unit)", "a limit")
    if too_long_for < np.inf:
        return (
            f"the proposal's tube leads farther than the {too_long_for:.3g} m that the filter looks ahead: the "
            "recorded driving says too little about this proposal"
        )
    if margin < 0.0:
        return f"the proposal's tube ends {-margin:.3g} {unit} beyond {edge}"
    return f"the proposal's tube comes within {margin:.3g} {unit} of {edge}"


@dataclass(frozen=True, eq=False)
class BlockingConstraint(ComparedByValue):
    """The constraint that a proposal violates most, or comes nearest to."""

    # The kind of an obstacle (`cylinder`, `box`, `sphere` or `wall`, with the prefix `moving ` if it moves), `unseen`,
    # `robot` (another robot's reservation), `sight` (the tube leaves the visible space), or the name of a limit.
    by: str
    # Distance from the tube to the half-space [m], or to the limit in its own unit. Negative if the tube crosses it.
    room: float
    after: float  # time from now [s]
    normal: Array  # (d,): normal of the half-space, away from the free side, world. Empty if there is no half-space.
    at: Array  # (d,): the obstacle's nearest point [m], on the half-space, world. Empty if there is no half-space.

    @staticmethod
    def nowhere(by: str, room: float, after: float) -> BlockingConstraint:
        return BlockingConstraint(by, room, after, np.zeros(0), np.zeros(0))


@dataclass(frozen=True)
class ConstraintSources:
    """The sources of the half-spaces, in the order of their rows, which repeats for each disc of the body."""

    near: Shapes
    moving: MovingObstacles | None
    unseen: OccupiedCells | OccludedRegions | None
    other_reservations: OtherReservations | None = None  # last, once for the whole body

    @property
    def obstacles(self) -> int:
        """Number of half-spaces, for each period, that belong to obstacles in the request."""
        return len(self.near) + (len(self.moving) if self.moving is not None else 0)


@dataclass(frozen=True)
class Planes:
    """Half-spaces for one disc of the body, in the order of `ConstraintSources`."""

    start: Array  # (d,): start of the nominal path of the disc's centre, world [m]
    ends: Array  # (N, d): its positions at the ends of the periods, world [m]
    normals: Array  # (n, N, d): normals of the half-spaces, world
    turned: Array  # (n, N, d): the same in the robot's frame
    offsets: Array  # (n, N): offsets about `start` [m], already reduced by `keep_off` and `measured`
    keep_off: float  # distance to the obstacles [m]
    measured: Array  # (d,): bound of the position's measurement error [m]

    def at_surface(self, which: int, period: int, margin: float = 0.0) -> tuple[Array, float]:
        """Return the normal (d,) and the offset of a half-space that touches the obstacle itself.

        `offsets` leave room for the body, the margin and the measurement error. This half-space does not.

        Args:
            which: number of the half-space.
            margin: margin of this obstacle [m].
        """
        normal = self.normals[which, period]
        distance = max(self.keep_off + margin, 0.0) + float(np.abs(normal) @ self.measured)
        return normal, float(self.offsets[which, period]) + distance


def blocking(
    row: int, room: float, robot: Robot, around: ConstraintSources, planes: list[Planes]
) -> BlockingConstraint:
    """Return the constraint of a row, which is `room` away. planes: the half-spaces of each disc under the proposal."""
    N, T = robot.horizon, robot.period
    number = row
    for disc in planes:
        rows = rows_per_obstacle(N) * len(disc.normals)
        if number < rows:
            return _obstacle_constraint(number, room, robot, around, disc)
        number -= rows
    if around.other_reservations is not None:
        corners = 2**robot.position_dim
        rows_each = (N + 1) * corners
        if number < len(around.other_reservations) * rows_each:
            period = (number % rows_each) // corners
            return BlockingConstraint.nowhere(ROBOT, room, T * min(period + 1, N))
        number -= len(around.other_reservations) * rows_each
    period, limit = divmod(number, len(robot.limits))
    first = 1 if robot.position_dim else 0  # the first period with a row for its start
    after = min(period + 1, N) if period <= N else period - N - 1 + first  # ends, stop, starts: see `StateLimits`
    return BlockingConstraint.nowhere(robot.limits[limit].name, room, T * after)


def _obstacle_constraint(
    row: int, room: float, robot: Robot, around: ConstraintSources, planes: Planes
) -> BlockingConstraint:
    """Return the constraint of a row that belongs to a disc."""
    N, T = robot.horizon, robot.period
    which, end = divmod(row, rows_per_obstacle(N))  # N starts of periods, N ends, then the stop
    period = end if end < N else min(end - N, N - 1)
    when = end if end < N else min(end - N + 1, N)
    start, ends = planes.start, planes.ends
    if isinstance(around.unseen, OccludedRegions) and which >= around.obstacles:
        by, (normal, level) = UNSEEN, planes.at_surface(which, period)
    elif which < len(around.near):
        by = around.near.kind(which)
        normal, level = planes.at_surface(which, period, float(around.near.margin[which]))
    else:
        by, normals, offsets = _moving_or_unseen(which - len(around.near), robot, around, start, ends)
        normal, level = normals[0, period], float(offsets[0, period])
    if not np.isfinite(level):
        return BlockingConstraint.nowhere(by, room, T * when)
    there = (ends[when - 1] if when else start) - start
    return BlockingConstraint(by, room, T * when, normal, start + there + normal * (level - normal @ there))


def _moving_or_unseen(
    which: int, robot: Robot, around: ConstraintSources, start: Array, ends: Array
) -> tuple[str, Array, Array]:
    """Return name and half-spaces (1, N, d), (1, N) of a moving obstacle or an unseen cell."""
    one, exact = np.array([which]), np.zeros(len(start))
    if around.moving is not None:
        if which < len(around.moving):
            mover = around.moving.take(one)
            return f"moving {mover.shapes.kind(0)}", *swept_half_spaces(mover, start, ends, 0.0, exact, robot.period)
        one -= len(around.moving)
    assert isinstance(around.unseen, OccupiedCells)
    return UNSEEN, *unseen_half_spaces(around.unseen.take(one), start, ends, 0.0, exact, robot.period)

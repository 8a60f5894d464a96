"""Limits of a robot's state (speed, tilt, keep-in box) as rows, like those of obstacles (docs/method.md §3)."""

from __future__ import annotations

import math
from copy import copy

import numpy as np

from brakeline.messaging.robot import Array, Robot
from brakeline.safety.filter.qp import ConstraintRows
from brakeline.safety.filter.reachable_tube import Tube
from brakeline.safety.model.model_set import extra_coordinates


class StateLimits:
    """The rows weightsᵀ y_k <= most at the end of each period, with the true state y_k.

    A limit of the position also holds within the periods and after the stop. In the robot's frame (position p_0,
    heading θ_0, rotation R):

        weights · y_k = a·p_0 + b θ_0 + (aᵀR) p_k + rest        a: weights of the position, b: of the heading

    so each period gives a row `gradient z + spread m(z) <= most - a·p_0 - b θ_0 - |weights|·Z_v`. Each period but the
    first also gives a row for its start, with its own chord deviation. The start of the first period has no row, so
    that a robot that was pushed beyond a limit may return. In that period it exceeds the limit by at most the chord
    deviation and its excess at the start.

    A measured heading is known up to whole turns. The limits of both sides bound an arc of less than a turn, and θ_0 is
    the heading that is nearest to the middle of this arc.

    In joint space, every limit holds within the periods and after the stop: the chord deviation of a period is how far
    a limit's value exceeds its values at both ends of the period, in units of `Robot.limit_scales`. There the first
    period has a row for its start, too. The order of the rows is: ends, stop, starts; each for all limits.

    Attributes:
        most (limits,): the largest values, less the measurement errors.
        position_weights (limits, d), heading_weights (limits,): a and b.
        arc_middle (limits,): the middle of the arc of headings [rad].
        other_weights, other_coordinates: the weights of the remaining coordinates, and their numbers in `Tube.more`.
        chord_scales (limits,): how much a limit's value changes with each unit of chord deviation.
        chord_columns (rows per limit, N + 1): the chord deviation of each row; the last column: the stopping distance.
        row_periods (rows per limit,): the period of each row; N: the start of the first period.
        position_maps, other_maps: the maps of the tube (`Tube`): columns for z, for the generators, for the constant.
        start_map: in joint space, the map of the first period's start; otherwise None.
    """

    def __init__(self, robot: Robot, tube: Tube) -> None:
        d, n, N = robot.position_dim, robot.state_dim, tube.horizon
        self.count, self.heading = len(robot.limits), robot.heading
        weights = robot.limit_weights
        self.most = np.array([limit.most for limit in robot.limits]) - np.abs(weights) @ robot.measurement_bound
        self.position_weights, self.heading_weights = weights[:, :d], np.zeros(self.count)
        if robot.heading is not None:
            self.heading_weights = weights[:, robot.heading]
        self.arc_middle = np.array([_middle_of_arc(robot, i) for i in range(self.count)])
        others = [i for i in extra_coordinates(robot) if i < n]
        self.other_weights = weights[:, others]
        self.other_coordinates = [extra_coordinates(robot).index(i) for i in others]
        self.nz, self.chord_columns = tube.position.shape[2], np.eye(N + 1)
        self.row_periods = np.append(np.arange(N), N - 1)
        self.chord_scales = np.linalg.norm(self.position_weights, axis=1) if d else robot.limit_scales
        self.start_map: Array | None = None
        if not d:
            self.start_map = np.zeros((1, self.count, self.nz + tube.generators + 1))
            self.start_map[0, :, : len(robot.regressor)] = weights[:, list(robot.regressor)]
            self.row_periods = np.append(self.row_periods, np.append(N, np.arange(N - 1)))
            self.chord_columns = np.vstack([self.chord_columns, self.chord_columns[:N]])
        elif self.position_weights.any():
            self.row_periods = np.append(self.row_periods, np.arange(N - 1))
            self.chord_columns = np.vstack([self.chord_columns, self.chord_columns[1:N]])
        self._set_maps(tube)

    def _set_maps(self, tube: Tube) -> None:
        """Set the maps of a tube: columns for z, for the generators, and for the constant."""
        N = tube.horizon
        maps = np.concatenate([tube.more, tube.more_directions, tube.more_offset[..., None]], axis=2)
        maps = maps[:, self.other_coordinates]
        self.other_maps = np.einsum("cr,nrz->ncz", self.other_weights, maps).reshape(N, self.count, maps.shape[2])
        self.position_maps = np.concatenate([tube.position, tube.directions, tube.offset[..., None]], axis=2)

    def around(self, tube: Tube) -> StateLimits:
        """Return the limits of the same robot around another tube."""
        other = copy(self)
        other._set_maps(tube)
        return other

    def __len__(self) -> int:
        return self.count * len(self.row_periods)

    def _headings_near_arcs(self, heading: float) -> Array:
        """Return the heading [rad] for each limit, shifted by whole turns to be nearest to the middle of its arc."""
        off = heading - self.arc_middle
        return self.arc_middle + off - math.tau * np.rint(off / math.tau)

    def rows(self, start: Array, heading: float, rotation: Array, widening: float) -> ConstraintRows:
        """Return the rows for a robot at `start` (d,) [m] with a heading [rad].

        rotation (d, d): from the frame of the robot to the world; widening: factor on the sets.
        """
        both = (self.position_weights @ rotation) @ self.position_maps + self.other_maps  # (N, limits, nz + L + 1)
        both = (both if self.start_map is None else np.concatenate([both, self.start_map]))[self.row_periods]
        bound = self.most - self.position_weights @ start
        bound = bound - self.heading_weights * self._headings_near_arcs(heading) - both[..., -1]
        # The chord deviation of every period, and the stopping distance at the last end.
        extra = self.chord_columns[:, None, :] * self.chord_scales[None, :, None]
        gradient = np.ascontiguousarray(both[..., : self.nz]).reshape(-1, self.nz)
        spread = widening * np.concatenate([np.abs(both[..., self.nz : -1]), extra], axis=2)
        count = len(gradient)
        return ConstraintRows(gradient, spread.reshape(count, -1), bound.ravel())


def _middle_of_arc(robot: Robot, number: int) -> float:
    """Return the middle [rad] of the headings that a limit and its opposite allow; 0 without an opposite.

    If several limits have the same weights, the strictest one counts on each side: a looser one would allow headings
    that a strict limit forbids, as they are nearest to its arc after a turn.
    """
    limit = robot.limits[number]
    weight = limit.weights[robot.heading] if robot.heading is not None else 0.0
    opposite = tuple(-value for value in limit.weights)
    most, other = (
        min((one.most for one in robot.limits if one.weights == side), default=None)
        for side in (limit.weights, opposite)
    )
    return 0.0 if other is None or most is None or not weight else 0.5 * (most - other) / weight


def stack_rows(parts: list[ConstraintRows]) -> ConstraintRows:
    """Return the rows of several groups, one group after the other."""
    if len(parts) == 1:
        return parts[0]
    return ConstraintRows(
        *(np.concatenate([getattr(p, name) for p in parts]) for name in ("gradient", "spread", "bound"))
    )

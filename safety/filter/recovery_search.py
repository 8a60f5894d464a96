"""Search for a slow way out, for a robot that stands where standing cannot be verified (docs/method.md §11)."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from brakeline.messaging.robot import Array, Robot
from brakeline.messaging.scan import Scan
from brakeline.safety.filter.backup_plan import UNVERIFIED
from brakeline.safety.filter.blocking_constraint import Planes
from brakeline.safety.filter.halfspaces import rows_per_obstacle
from brakeline.safety.filter.local_map import LocalMap
from brakeline.safety.filter.plan_search import PlanCandidate
from brakeline.safety.filter.qp import ConstraintRows
from brakeline.safety.filter.recovery import SLOW, harmless, least_violating, slow_inputs, turn_towards
from brakeline.safety.filter.request import RECOVERING, Request
from brakeline.safety.perception.image_coverage import has_blind_directions
from brakeline.safety.perception.scan_free_space import blind_near, shows_free

if TYPE_CHECKING:
    from brakeline.safety.filter.filter import Filter


class RecoverySearch:
    """The search for one decision.

    Attributes:
        safety: the filter. local_map: the surroundings. z_0 (known,): regressors that are known.
        before (m,): the input in force.
        moves: the robot is on a way out already.
        touched (n,): which reservations of other robots the robot's own one touches.
    """

    def __init__(self, safety: Filter, request: Request, local_map: LocalMap, z_0: Array) -> None:
        self.safety, self.request, self.local_map, self.z_0 = safety, request, local_map, z_0
        self.before = z_0[-safety.robot.action_dim :]
        self.moves = is_on_a_way_out(safety.robot, request)
        own, others = request.reservation, request.other_reservations
        self.touched = np.zeros(0, dtype=bool) if own is None or others is None else others.touched(own)

    def candidate(self) -> PlanCandidate | None:
        """Return the plan of the way out; None if the robot needs none, or if there is none."""
        safety, local_map = self.safety, self.local_map
        stand = safety.inputs.regressors(self.z_0, safety.executable.stop(self.request.state, self.before))
        if not self._is_needed(stand):
            return None
        constraints = safety.constraints.at(stand, local_map.widening)
        planes = constraints.planes(local_map, stand, leaving=True)
        rows = constraints.rows(local_map, stand, planes)
        if not np.isfinite(rows.bound).all():  # an obstacle that is just touched, or NaN, has no known side
            return None
        standing = rows.support(safety.tube, stand) - rows.bound
        z = self._slow_input(rows, planes, stand, standing)
        if z is None:
            z = self._turn(rows, planes, stand, standing)
        if z is None:
            return None
        margin, own = constraints.margin(rows, z), safety.constraints.at(z, local_map.widening)
        return PlanCandidate(RECOVERING, safety.inputs.plan(z), z, margin, False, own)

    def _is_needed(self, stand: Array) -> bool:
        """Return whether a robot that stands, or is on a way out, violates more by standing than it may seem to.

        It may seem to violate what two measurement errors explain. Where it stays as it stands, the clearance margin
        comes on top. A robot whose reservation touches another's has no verified plan, however little they touch.
        """
        safety, request, local_map = self.safety, self.request, self.local_map
        if not (request.still(safety.robot) or self.moves):
            return False
        if isinstance(request.scan, Scan) and not shows_free(request.scan, local_map.start):
            return False
        seeming = 0.0
        if not (self.moves or self.touched.any()):
            seeming = 2.0 * safety.constraints.measurement_error
            seeming += safety.clearance_margin if safety.constraints.stays else 0.0
        constraints = safety.constraints_for(stand, local_map.widening)
        return constraints.margin_in(local_map.parked, stand) < -seeming and not self._is_blind(
            constraints.extent(stand)
        )

    def _is_blind(self, within: float) -> bool:
        """Return whether the scan has no information about space within a distance [m]: no way leads out of that."""
        scan = self.request.scan
        if isinstance(scan, Scan):
            return blind_near(scan, self.local_map.start, within)
        return scan is not None and has_blind_directions(scan)

    def _slow_input(self, rows: ConstraintRows, planes: list[Planes], stand: Array, standing: Array) -> Array | None:
        """Return the regressors (nz,) of the slow input that violates least, or None if none is better than standing.

        All candidates are compared with the tube width of standing. With their own widths, a robot with a loose model
        set would go where its motion is known best, which is not the way out.
        """
        robot, inputs = self.safety.robot, self.safety.inputs
        # In real time an input is taken back a period late, so it must be reachable within one slew.
        most = np.asarray(robot.action_slew) if robot.committed_steps else np.full(robot.action_dim, np.inf)
        slow = [inputs.limited(np.clip(u, -most, most), self.before) for u in slow_inputs(robot)]
        plans = [inputs.regressors(self.z_0, action) for action in slow]
        violated = standing + (np.array(plans) - stand) @ rows.gradient.T
        others = 0 if (near := self.local_map.other_reservations) is None else len(near)
        ends = ends_of_plan(robot, planes, len(rows.bound), others)
        while (best := least_violating(violated, standing, ends)) is not None and self._comes_upon_another(plans[best]):
            violated[best] = np.inf
        return None if best is None else plans[best]

    def _turn(self, rows: ConstraintRows, planes: list[Planes], stand: Array, standing: Array) -> Array | None:
        """Return the regressors (nz,) of a turn towards the open side; None if it comes nearer to anything.

        A turn moves only the discs beside the measured position.
        """
        safety, away, others = self.safety, self.local_map.away, self.request.other_reservations
        if others is not None and self.touched.any():
            ways = -others.take(self.touched).shapes.towards(self.local_map.start)
            away = ways[np.argmin(np.einsum("nd,nd->n", ways, ways))]
        if safety.robot.heading is None or away is None:
            return None
        turn = turn_towards(safety.robot, self.local_map.heading, away)
        z = safety.inputs.regressors(self.z_0, safety.inputs.limited(turn, self.before))
        rows_of_disc = [rows_per_obstacle(safety.robot.horizon) * len(disc.normals) for disc in planes]
        swung = np.flatnonzero(np.repeat([disc.aside for disc in safety.constraints.discs], rows_of_disc))
        turned = standing[swung] + rows.gradient[swung] @ (z - stand)
        return z if harmless(turned[None], standing[swung])[0] and not self._comes_upon_another(z) else None

    def _comes_upon_another(self, z: Array) -> bool:
        """Return whether the reservation of a plan touches one that the robot's own one does not touch."""
        if (others := self.request.other_reservations) is None:
            return False
        local_map = self.local_map
        own = self.safety.constraints.at(z, local_map.widening)
        plan = self.safety.reserve(own, local_map.start, local_map.turn, z)
        return bool((others.touched(plan) & ~self.touched).any())


def is_on_a_way_out(robot: Robot, request: Request) -> bool:
    """Return whether a robot follows a plan that is not verified, at speeds of a way out."""
    slow = np.where(robot.translates, SLOW + 0.05, 1.0) * np.maximum(robot.high(), -robot.low())
    going = np.vstack([request.input_in_force, request.plan[: robot.committed_steps]])
    return request.model == UNVERIFIED and bool(going.any() and (np.abs(going) <= slow).all())


def ends_of_plan(robot: Robot, planes: list[Planes], count: int, others: int = 0) -> NDArray[np.bool_]:
    """Return which of `count` rows are of the end of the plan: for each obstacle the row after the stop.

    others: number of reservations of other robots. Of each, it is the row of the last set.
    """
    rows_each, (N, d) = rows_per_obstacle(robot.horizon), (robot.horizon, robot.position_dim)
    ends, of_obstacles = np.zeros(count, dtype=bool), rows_each * sum(len(disc.normals) for disc in planes)
    ends[rows_each - 1 : of_obstacles : rows_each] = True
    rows_each = (N + 1) << d  # of a reservation
    ends[of_obstacles + rows_each - 1 : of_obstacles + rows_each * others : rows_each] = True
    if not robot.position_dim:
        ends[robot.horizon * len(robot.limits) : (robot.horizon + 1) * len(robot.limits)] = True
    return ends

"""The surroundings of a robot as rows that constrain its tube (docs/method.md §3, §8-§10)."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from brakeline.messaging.obstacle import FARTHEST
from brakeline.messaging.range_image import RangeImage
from brakeline.messaging.robot import Array, Robot
from brakeline.safety.filter.backup_plan import Prediction
from brakeline.safety.filter.blocking_constraint import SIGHT, BlockingConstraint, ConstraintSources, Planes, blocking
from brakeline.safety.filter.clearance_margin import ClearanceMargin
from brakeline.safety.filter.halfspaces import half_spaces, half_spaces_leading_out
from brakeline.safety.filter.kernels import halfspace_kernels, qp_kernels, tube_kernels
from brakeline.safety.filter.local_map import LocalMap, local_map
from brakeline.safety.filter.moving_halfspaces import swept_half_spaces
from brakeline.safety.filter.qp import Center, ConstraintRows, ObstacleRows
from brakeline.safety.filter.reachable_tube import RolloutTube, Tube
from brakeline.safety.filter.request import Request
from brakeline.safety.filter.reservation import ReservationRows, reservation_half_spaces
from brakeline.safety.filter.state_limits import StateLimits, stack_rows
from brakeline.safety.filter.tube_extent import stays, widest_extent
from brakeline.safety.filter.widening import CHANGED
from brakeline.safety.model.model_config import DIRECT
from brakeline.safety.model.model_set import ModelSet, deciding_coordinates, extra_coordinates
from brakeline.safety.perception import occluded_regions as shades
from brakeline.safety.perception import scan_free_space as seen

ASIDE = 0.5  # m beyond all plans: what a range image is looked at for, and so the largest margin that it tells


@dataclass(frozen=True)
class _Disc:
    """A disc (or sphere) of the body.

    Attributes:
        at (d,): its center in the robot's frame. radius [m].
        swing [m]: error of its position due to the error of the measured heading.
        among: its coordinates among `Tube.more`; None if its center is the measured position.
        layout: builds its rows.
        aside: its center differs from the measured position.
    """

    at: Array
    radius: float
    swing: float
    among: slice | None
    layout: ObstacleRows
    aside: bool

    def center(self, tube: Tube) -> Center:
        """Return the affine map from regressors to the displacements of its center, and the factors on its sets."""
        if self.among is None:
            return tube.position, tube.offset, tube.stretch
        return np.ascontiguousarray(tube.more[:, self.among]), tube.more_offset[:, self.among], tube.stretch


def _discs(robot: Robot, tube: Tube) -> list[_Disc]:
    """Return the discs of the body, for tubes with the sets of this one."""
    d, discs = robot.position_dim, []
    after = len(extra_coordinates(robot)) - d * sum(disc.arm > 0.0 for disc in robot.body)
    for disc in robot.body:
        at, among, directions, swing = np.asarray(disc.at), None, tube.directions, 0.0
        if disc.arm and robot.heading is not None:
            among = slice(after, after + d)
            directions, after = tube.more_directions[:, among], after + d
            swing = disc.arm * robot.measurement_bound[robot.heading]
        aside = bool(at.any() or swing)
        discs.append(_Disc(at, disc.radius, swing, among, ObstacleRows(directions), aside))
    return discs


def growth_of(model: ModelSet, tube: Tube) -> float:
    """Return the further factor on the sets of plans, once the set of the next state is widened (docs/method.md §15).

    A set of mode direct is widened by what single periods show. An error of random sign adds up to √k times itself in k
    periods. So it uses more of a position's set after k periods than of the first one if that set is hardly wider. The
    factor says how much more. It is the smaller of two: at rest, and in a stop from full speed.
    """
    robot = model.robot
    if model.model_config.mode != DIRECT or not robot.position_dim:
        return 1.0
    high = np.asarray(robot.high())
    plans = [
        np.concatenate([model.measured_at(inputs), inputs, np.tile(inputs, robot.free_steps)])
        for inputs in (0.0 * high, high)
    ]
    half = np.stack([tube.half_widths(z) for z in plans])  # (2, N, d)
    times = np.sqrt(np.arange(1.0, half.shape[1] + 1.0))[:, None]
    return max(1.0, float((times * half[:, :1] / half).max((1, 2)).min()))


class TubeConstraints:
    """A tube, and the rows that the surroundings of a robot add to it.

    Attributes:
        measured (d,): half-widths of the position's measurement error [m].
        measurement_error: their norm [m]; in joint space, the largest error of a limit's value.
        clearance: the clearance margin that the QP keeps. reach [m]: see `Filter`.
        widest [m]: no tube, with the body, goes farther.
        far: a tube may leave the sensor's range, so every candidate is checked against it.
        stays: a robot that stands stays where it stands (it does not drift).
        stands: number of periods after which a plan has brought the robot to a stand.
        growth: see `growth_of`.
        decide (n,): see `deciding_coordinates`.
    """

    def __init__(
        self,
        model: ModelSet,
        tube: Tube,
        outer: Tube,
        domain: Array,
        clearance: ClearanceMargin,
        reach: float | None = None,
    ) -> None:
        """Prepare a tube.

        Args:
            tube: the exact tube. outer: an outer tube with fewer rows in W.
            domain (2, r): range of the recorded [x_0; input in force].
            clearance: the clearance margin that the QP keeps.
            reach [m]: radius of the local maps. By default as much as this tube needs.
        """
        robot = model.robot
        if robot.position_dim == 3:
            shades.prepare()
        self.robot, self.stands, self.growth = robot, model.moving, growth_of(model, tube)
        whole = np.ascontiguousarray
        self._sized = whole(tube.W.T), whole(tube.M.T), tube.m_0
        first, n = model.first, robot.state_dim
        transposed = whole(first.W.T), whole(first.M.T), whole(first.kappa.T)
        self._next = whole(first.C[:n]), *transposed, first.w, whole(np.abs(first.generators[:n]))
        self._regressor, self.decide = model.first_regressor, deciding_coordinates(robot)
        self.measured = np.asarray(robot.measurement_bound[: robot.position_dim], dtype=float)
        self.measurement_error = float(np.linalg.norm(self.measured))
        if not robot.position_dim:
            self.measurement_error = float((np.abs(robot.limit_weights) @ robot.measurement_bound).max())
        self._unturned, self._unmoved = np.eye(robot.position_dim), np.zeros(n)
        self.body = robot.footprint + float(np.linalg.norm(self.measured))  # m
        self.clearance = clearance
        self.discs = _discs(robot, tube)
        self.limits = StateLimits(robot, tube) if robot.limits else None
        farthest = max((float(np.linalg.norm(disc.at)) for disc in self.discs), default=0.0)
        self._beside = self.measured + clearance.largest + ASIDE + farthest
        self.stays = stays(model, tube)
        if robot.position_dim:
            self.widest = widest_extent(robot, tube, outer, domain, self.body)
            wanted = self.widest + clearance.largest
            self.reach = min(wanted, robot.sight) if reach is None else reach
            self.far = wanted > self.reach or isinstance(tube, RolloutTube)  # interval arithmetic bounds no rollout
        else:  # nothing is near or far: the reach only bounds margins
            self.widest, self.reach, self.far = 0.0, FARTHEST, False
        self._surround(tube, 1.0)

    def _surround(self, tube: Tube, widening: float) -> None:
        """Set the tube, and what depends on it."""
        self.tube, self.widening = tube, widening
        self._reached = *self._sized, np.ascontiguousarray(tube.position), tube.offset, tube.directions, widening
        self._boxes: ReservationRows | None = None

    def at(self, z: Array, widening: float = 1.0) -> TubeConstraints:
        """Return the constraints with a tube that is exact for regressors z (nz,) and has affine centers.

        widening: factor on every set of the tube, at least 1 (docs/method.md §15).
        """
        tube = self.tube.at(z)
        if tube is self.tube and widening == self.widening:
            return self
        other = object.__new__(TubeConstraints)
        vars(other).update(vars(self))
        other._surround(tube, widening)
        if self.robot.position_dim:
            other.reach = self._reach_for(widening)
            other.far = self.far or widening > 1.0  # the reach is that of tubes without it
        return other

    def plan_widening(self, asked: float) -> float:
        """Return the factor on the sets of a plan, for the factor that a request asks for (docs/method.md §15)."""
        return asked * self.growth if asked > 1.0 else 1.0

    def _reach_for(self, widening: float) -> float:
        """Return the radius [m] of local maps for tubes that are wider by a factor; no plan leaves it unnoticed."""
        return min(self.reach * widening, max(self.robot.sight, self.reach))

    def extent(self, z: Array) -> float:
        """Return the distance [m] from the measured position to the farthest point of the body in the tube of z."""
        return tube_kernels.extent(*self._reached, z, self.body)

    # --- one request ---------------------------------------------------------------------------------------------

    def local_map(self, request: Request, z_0: Array, inputs: tuple[Array, Array]) -> LocalMap:
        """Return the map of a request. inputs: center and half-widths of a plan's free inputs after z_0."""
        robot, occluded, widening = self.robot, None, self.plan_widening(request.widening)
        turn = self.turn(float(request.state[robot.heading]) if robot.heading is not None else 0.0)
        if isinstance(request.scan, RangeImage):
            start = np.ascontiguousarray(request.state[: robot.position_dim])
            room = self._room(z_0, inputs, start, turn, widening)
            occluded = shades.occluded_regions(request.scan, room, self.body, start)
        return local_map(robot, request, widening, self._reach_for(widening), turn, occluded)

    def turn(self, heading: float) -> Array:
        """Return the rotation (d, d) from the robot's frame to the world."""
        if self.robot.heading is None:
            return self._unturned
        turn = self._unturned.copy()
        cos, sin = math.cos(heading), math.sin(heading)
        turn[0, 0], turn[0, 1], turn[1, 0], turn[1, 1] = cos, -sin, sin, cos
        return turn

    def _room(
        self, z_0: Array, inputs: tuple[Array, Array], start: Array, turn: Array, widening: float
    ) -> shades.PlanBoxes:
        """Return boxes, world, that contain the discs' centers under every plan after z_0, with room to spare."""
        z = np.concatenate([z_0, inputs[0]])
        if isinstance(self.tube, RolloutTube):  # a verified plan does not leave the reach, and no box of it is smaller
            aside = self._reach_for(widening) + self._beside
            boxes = np.tile(np.stack([start - aside, start + aside])[:, None], (1, self.robot.horizon + 1, 1))
        else:
            boxes = halfspace_kernels.filled_by_plans(*self._filled, widening, z, inputs[1], self._beside, start, turn)
        return shades.PlanBoxes(boxes, self.robot.horizon * self.robot.period)

    @cached_property
    def _filled(self) -> tuple[Array, Array, Array, Array, Array, Array, Array, Array]:
        """The arguments of `filled_by_plans` that are the same for all requests."""
        tube, whole, free = self.tube, np.ascontiguousarray, self.robot.free_steps - self.robot.committed_steps
        chosen = slice(-self.robot.action_dim * free, None)
        sizes = whole(tube.W), whole(np.abs(tube.W[:, chosen])), whole(tube.M), tube.m_0
        position, moved = whole(tube.position), whole(np.abs(tube.position[..., chosen]))
        return *sizes, position, tube.offset, moved, whole(np.abs(tube.directions))

    def sets(self, start: Array, turn: Array, z: Array) -> tuple[Array, Array]:
        """Return centers and half-widths (N, d), world, of the boxes of the true positions at the periods' ends."""
        return tube_kernels.sets(*self._reached, z, np.ascontiguousarray(start, dtype=float), turn, self.measured)

    def predict(self, local_map: LocalMap, z: Array) -> Prediction:
        """Return the predicted set of the next measured state, all coordinates (docs/method.md §2)."""
        tube = self.tube
        first, stretch = (tube.first, float(tube.stretch[0])) if len(tube.first) else (self._unmoved, 1.0)
        factors, start = local_map.state_factors(self.decide) * stretch, np.ascontiguousarray(local_map.start)
        center, half = tube_kernels.next_state(*self._next, self._regressor(z), first, factors, start, local_map.turn)
        if self.robot.heading is not None:
            center[self.robot.heading] += local_map.heading
        return Prediction(center, half, local_map.heading)

    def margin(self, rows: ConstraintRows, z: Array) -> float:
        """Return the smallest slack [m, or the unit of a limit] of the rows for the exact tube of z."""
        sizes = tube_kernels.magnitudes(*self._sized, z)
        return self.least(qp_kernels.row_slack(rows.gradient, rows.spread, rows.bound, z, sizes), z)

    def margin_in(self, local_map: LocalMap, z: Array) -> float:
        """Return the margin of the plan with regressors z in a map (docs/method.md §3)."""
        return self.least(self.slack(local_map, z), z)

    def least(self, slack: Array, z: Array, nearer: float = 0.0) -> float:
        """Return the smallest slack, limited to ± the reach (less `nearer`). NaN counts as the worst."""
        most = self.reach - nearer
        margin = halfspace_kernels.least(slack, most)
        if self.far:
            margin = min(margin, most - self.extent(z))
        return max(margin, -self.reach) if margin == margin else -self.reach

    def planes(self, local_map: LocalMap, z: Array, leaving: bool = False) -> list[Planes]:
        """Return the half-spaces for the plan with regressors z, for each disc of the body.

        leaving: for an obstacle that contains the disc, take the half-space that leads out of it.
        """
        planes = []
        for disc in self.discs:
            start, measured = local_map.start, self.measured
            if disc.aside:
                start, measured = start + local_map.turn @ disc.at, measured + disc.swing
            position, offset, _ = disc.center(self.tube)
            ends = tube_kernels.places(position, offset, z, start, local_map.turn)
            beside = []
            if len(local_map.near) or local_map.unseen is None:
                beside.append(half_spaces(local_map.near, start, ends, disc.radius, measured))
                if leaving:
                    beside[0] = half_spaces_leading_out(local_map.near, start, disc.radius, measured, beside[0])
            if local_map.moving is not None:
                beside.append(
                    swept_half_spaces(local_map.moving, start, ends, disc.radius, measured, self.robot.period)
                )
                self._let_pass(beside[-1][1], local_map)
            if local_map.unseen is not None:
                of = shades if isinstance(local_map.unseen, shades.OccludedRegions) else seen
                beside.append(of.half_spaces(local_map.unseen, start, ends, disc.radius, measured, self.robot.period))
                if isinstance(local_map.unseen, seen.OccupiedCells) and local_map.unseen.speed > 0.0:
                    self._let_pass(beside[-1][1], local_map)
            normals, offsets = beside[0] if len(beside) == 1 else map(np.concatenate, zip(*beside, strict=True))
            turned = normals if self.robot.heading is None else normals @ local_map.turn
            planes.append(Planes(start, ends, normals, turned, offsets, disc.radius, measured))
        return planes

    def _let_pass(self, levels: Array, local_map: LocalMap) -> None:
        """Drop the half-spaces (n, N) of moving obstacles for periods in which the robot stands (passive safety, §8).

        A robot that has changed may stand later, so none is dropped. A NaN stays NaN.
        """
        if local_map.asked_widening > CHANGED:
            return
        late = levels[:, self.stands :]
        late[late == late] = FARTHEST  # not of NaN

    def rows(self, local_map: LocalMap, z: Array, planes: list[Planes] | None = None) -> ConstraintRows:
        """Return the half-spaces of the plan with regressors z as rows, for the tube and for the outer tube of the QP.

        Both tubes have the same generators; only the magnitudes differ. planes: the half-spaces, if known already.
        """
        planes, tube = planes or self.planes(local_map, z), self.tube.affine(z)
        parts = []
        for disc, plane in zip(self.discs, planes, strict=True):
            parts.append(disc.layout.rows(disc.center(tube), plane.turned, plane.offsets, self.widening))
        return stack_rows(parts + self._further(local_map, tube, z))

    def slack(self, local_map: LocalMap, z: Array, planes: list[Planes] | None = None) -> Array:
        """Return `bound - support` (rows,) of the same rows."""
        sizes = tube_kernels.magnitudes(*self._sized, z)
        if self.widening != 1.0:
            sizes *= self.widening
        parts = []
        for disc, plane in zip(self.discs, planes or self.planes(local_map, z), strict=True):
            parts.append(disc.layout.slack(disc.center(self.tube), plane.turned, plane.offsets, sizes, z))
        if self.limits is not None or local_map.other_reservations is not None:
            tube = self.tube.affine(z)
            parts += [rows.bound - rows.support(tube, z) for rows in self._further(local_map, tube, z)]
        return parts[0] if len(parts) == 1 else np.concatenate(parts)

    def _further(self, local_map: LocalMap, tube: Tube, z: Array) -> list[ConstraintRows]:
        """Return the rows of reservations and of state limits. tube: with centers that are affine in z."""
        parts = []
        if local_map.other_reservations is not None:
            nominal = local_map.start + tube.centers(z) @ local_map.turn.T
            body = self.robot.footprint
            planes = reservation_half_spaces(
                local_map.other_reservations, local_map.start, nominal, body, self.measured
            )
            boxes = self._boxes or ReservationRows(tube.position, tube.offset, tube.directions)
            self._boxes = boxes if tube is self.tube else None
            parts.append(boxes.rows(*planes, local_map.turn, self.widening))
        if self.limits is not None:
            limits = self.limits if tube is self.tube else self.limits.around(tube)
            parts.append(limits.rows(local_map.start, local_map.heading, local_map.turn, self.widening))
        return parts

    def kept_off(self, planes: list[Planes], rows: int) -> Array:
        """Return the clearance margin (rows,) [m] by which each row is tightened.

        It is the largest one for reservations, and none for limits, the last rows.
        """
        of_obstacles = self.clearance.of_rows(planes)
        if len(of_obstacles) == rows:
            return of_obstacles
        kept_off = np.full(rows, self.clearance.largest)
        kept_off[: len(of_obstacles)] = of_obstacles
        if self.limits is not None:
            kept_off[rows - len(self.limits) :] = 0.0
        return kept_off

    def worst_of(
        self, local_map: LocalMap, z: Array, slack: Array, planes: list[Planes], with_clearance: bool
    ) -> BlockingConstraint:
        """Return the constraint that blocks the proposal with regressors z most: with the clearance margin, or without.

        The end of the sensor's range has the largest margin.
        """
        beyond = self.reach - self.extent(z) if self.far else np.inf
        short, beyond_by = slack, beyond
        if with_clearance:
            short, beyond_by = slack - self.kept_off(planes, len(slack)), beyond - self.clearance.largest
        if not len(slack) or beyond_by < short.min():
            return BlockingConstraint.nowhere(SIGHT, beyond, self.robot.period * self.robot.horizon)
        row = int(np.argmin(short))
        around = ConstraintSources(local_map.near, local_map.moving, local_map.unseen, local_map.other_reservations)
        return blocking(row, max(float(slack[row]), -self.reach), self.robot, around, planes)

    def clear(self, request: Request, local_map: LocalMap, z: Array, margin: float) -> tuple[float, bool]:
        """Return the margin [m] for a report, and whether it is only a lower bound.

        An obstacle beyond reach changes no decision, but may be nearest to the tube. Then the lower bound is its
        distance less the extent of the tube. margin [m]: to everything within reach.
        """
        if isinstance(local_map.unseen, shades.OccludedRegions) and margin >= ASIDE:
            return margin, True
        if not self.far and margin + self.widest <= self.reach:
            return margin, False
        extent = self.extent(z)
        if self.far:
            return margin, margin >= self.reach - extent
        if margin < self.reach and margin <= local_map.beyond - extent:
            return margin, False
        # The filter does not evaluate a scan beyond its reach.
        most = self.robot.sight - self.widest if local_map.empty and request.scan is None else self.reach
        return min(local_map.beyond - extent, most), True

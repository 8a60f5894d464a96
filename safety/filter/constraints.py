"""The surroundings of a robot as rows that constrain its tube (docs/method.md §3, §8-§10)."""

from __future__ import annotations

import math
from copy import copy
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from brakeline.messaging.moving_obstacles import MovingObstacles
from brakeline.messaging.obstacle import FARTHEST, Shapes
from brakeline.messaging.range_image import RangeImage
from brakeline.messaging.robot import Robot
from brakeline.messaging.scan import Scan
from brakeline.safety.filter.backup_plan import Prediction
from brakeline.safety.filter.blocking_constraint import SIGHT, BlockingConstraint, ConstraintSources, Planes, worst
from brakeline.safety.filter.halfspaces import half_spaces, half_spaces_leading_out
from brakeline.safety.filter.kernels import halfspace_kernels, tube_kernels
from brakeline.safety.filter.moving_halfspaces import swept_half_spaces
from brakeline.safety.filter.qp import ConstraintRows, ObstacleRows
from brakeline.safety.filter.reachable_tube import RolloutTube, Tube
from brakeline.safety.filter.recovery import escape_direction
from brakeline.safety.filter.request import Request
from brakeline.safety.filter.reservation import OtherReservations, ReservationRows, reservation_half_spaces
from brakeline.safety.filter.state_limits import StateLimits, stack_rows
from brakeline.safety.model.model_set import ModelSet, extra_coordinates
from brakeline.safety.perception import occluded_regions as shades
from brakeline.safety.perception import scan_free_space as seen

Array = NDArray[np.float64]

ROOM_FOR_STRETCH = 1.2  # of the reach of a rollout, whose sets grow with the leverage of a plan
EXTREMES = 4096  # plans with extreme regressors, for the reach of a rollout
ASIDE = 0.5  # m beyond all plans: what a range image is looked at for, and so the largest margin that it tells


@dataclass(frozen=True)
class _Disc:
    """A disc (or sphere) of the body, and the tube of its center.

    Attributes:
        at (d,): its center in the robot's frame. radius [m].
        swing [m]: error of its position due to the error of the measured heading.
        position (N, d, nz), offset (N, d): affine maps from regressors to its displacements. layout: builds its rows.
    """

    at: Array
    radius: float
    swing: float
    position: Array
    offset: Array
    layout: ObstacleRows

    @cached_property
    def aside(self) -> bool:
        """Whether its center differs from the measured position."""
        return bool(self.at.any() or self.swing)


def _discs(robot: Robot, tube: Tube, known: list[_Disc] | None = None) -> list[_Disc]:
    """Return the discs of the body in a tube. known: the same discs in a tube with the same sets."""
    d, found = robot.position_dim, []
    after = len(extra_coordinates(robot)) - d * sum(disc.arm > 0.0 for disc in robot.body)
    for i, disc in enumerate(robot.body):
        position, offset, directions, swing = tube.position, tube.offset, tube.directions, 0.0
        if disc.arm and robot.heading is not None:
            of = slice(after, after + d)
            position, offset, directions = tube.more[:, of], tube.more_offset[:, of], tube.more_directions[:, of]
            swing = disc.arm * robot.measurement_bound[robot.heading]
            after += d
        if known is None:
            layout = ObstacleRows(position, offset, directions)
        else:
            layout = known[i].layout.around(position, offset, tube.stretch)
        found.append(_Disc(np.asarray(disc.at), disc.radius, swing, np.ascontiguousarray(position), offset, layout))
    return found


@dataclass(frozen=True)
class LocalMap:
    """What a request says about the space within reach of a robot, in the world.

    Attributes:
        start (d,), heading [rad]: measured pose. turn (d, d): rotation from the robot's frame to the world.
        near: obstacles within reach. moving: moving obstacles that may come within reach.
        beyond [m]: the distance below which the request names no further obstacle, at most the sensor's range.
        unseen: space that a scan does not show to be free. other_reservations: those of other robots.
        widening: factor that the request puts on every set (docs/method.md §15).
    """

    start: Array
    heading: float
    turn: Array
    near: Shapes
    beyond: float
    moving: MovingObstacles | None = None
    unseen: seen.OccupiedCells | shades.OccludedRegions | None = None
    other_reservations: OtherReservations | None = None
    widening: float = 1.0

    @property
    def parked(self) -> LocalMap:
        """Return the map without what moves: a standing robot need not avoid it (passive safety, §8)."""
        unseen = None if self.unseen is not None and self.unseen.speed > 0.0 else self.unseen
        return replace(self, moving=None, unseen=unseen)

    @property
    def away(self) -> Array | None:
        """The direction (d,), world, away from what is nearest to the start; None if nothing near has a direction."""
        ways = [escape_direction(self.near, self.start)[None]] if len(self.near) else []
        if isinstance(self.unseen, seen.OccupiedCells):
            ways.append(self.start - self.unseen.corners.reshape(-1, len(self.start)))
        each = np.concatenate(ways or [np.zeros((0, len(self.start)))])
        return each[np.argmin(np.einsum("nd,nd->n", each, each))] if len(each) else None

    @property
    def empty(self) -> bool:
        return not len(self.near) and self.moving is None and self.unseen is None and self.other_reservations is None


def turning_extent(robot: Robot, tube: Tube) -> float:
    """Return the default clearance margin [m]: the extent of the tube of turning in place at the highest turn rate.

    Without this margin a robot may stop so close to an obstacle that no motion can be verified from there.
    """
    if not robot.position_dim:
        return 0.0
    in_place = np.where([not moves for moves in robot.translates], robot.high(), 0.0)
    state = robot.state_at_inputs(in_place)
    z = np.concatenate([state[list(robot.regressor)], in_place, np.tile(in_place, robot.free_steps)])
    tube = tube.at(z)
    sizes = tube.magnitudes(z)
    L, d = tube.generators, robot.position_dim
    directions = np.random.default_rng(0).normal(size=(64, d))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    width = np.abs(directions[:, None, None, :] @ tube.directions)[:, :, 0] @ sizes[:L]
    drift = np.abs((directions[:, None, None, :] @ tube.position)[:, :, 0] @ z + directions @ tube.offset.T)
    return float((width + drift).max() + sizes[L:].max())


class TubeConstraints:
    """A tube, and the rows that the surroundings of a robot add to it.

    Attributes:
        measured (d,): half-widths of the position's measurement error [m].
        measurement_error: their norm [m]; in joint space, the largest error of a limit's value.
        clearance_margin, reach [m]: see `Filter`. widest [m]: no tube, with the body, goes farther.
        far: a tube may leave the sensor's range, so every candidate is checked against it.
        stays: a robot that stands stays where it stands (it does not drift).
        stands: number of periods after which a plan has brought the robot to a stand.
    """

    def __init__(
        self,
        model: ModelSet,
        tube: Tube,
        outer: Tube,
        domain: Array,
        clearance_margin: float,
        reach: float | None = None,
    ) -> None:
        """Prepare a tube.

        Args:
            tube: the exact tube. outer: an outer tube with fewer rows in W.
            domain (2, r): range of the recorded [x_0; input in force].
            clearance_margin [m]: distance from obstacles that the QP keeps.
            reach [m]: radius of the local maps. By default as much as this tube needs.
        """
        robot = model.robot
        if robot.position_dim == 3:
            shades.prepare()
        self.robot, self.tube, self.stands = robot, tube, model.moving
        self.widening = 1.0
        self._base: TubeConstraints | None = None
        self._free = free = len(robot.action_slew) * (robot.free_steps - robot.committed_steps)
        whole = np.ascontiguousarray
        self._spans, self._W_free = whole(np.abs(tube.directions)), whole(np.abs(tube.W[:, -free:]))
        self._sized = whole(tube.W.T), whole(tube.M.T), tube.m_0
        self._directions = whole(tube.directions)
        first, n = model.first, robot.state_dim
        self._first_stretch = 1.0
        self._first = tube.first if len(tube.first) else np.zeros(n)
        transposed = whole(first.W.T), whole(first.M.T), whole(first.kappa.T)
        self._next = whole(first.C[:n]), *transposed, first.w, whole(np.abs(first.generators[:n]))
        self._regressor = model.first_regressor
        self.measured = np.asarray(robot.measurement_bound[: robot.position_dim], dtype=float)
        self.measurement_error = float(np.linalg.norm(self.measured))
        if not robot.position_dim:
            self.measurement_error = float((np.abs(robot.limit_weights) @ robot.measurement_bound).max())
        self._unturned = np.eye(robot.position_dim)
        self.body = robot.footprint + float(np.linalg.norm(self.measured))  # m
        self.clearance_margin = clearance_margin
        farthest = max((float(np.linalg.norm(disc.at)) for disc in self.discs), default=0.0)
        self._beside = self.measured + self.clearance_margin + ASIDE + farthest
        self.stays = self._stays()
        if not robot.position_dim:  # nothing is near or far: the reach only bounds margins
            self.widest, self.reach, self.far = 0.0, FARTHEST, False
            return
        self.widest = self._widest(outer, domain)
        wanted = self.widest + self.clearance_margin
        self.reach = min(wanted, robot.sight) if reach is None else reach
        self.far = wanted > robot.sight or isinstance(tube, RolloutTube)  # interval arithmetic bounds no rollout

    def at(self, z: Array, widening: float = 1.0) -> TubeConstraints:
        """Return the constraints with a tube that is exact for regressors z (nz,) and has affine centers.

        widening: factor on every set of the tube, at least 1 (docs/method.md §15).
        """
        tube = self.tube.at(z)
        if tube is self.tube and widening == self.widening:
            return self
        other = copy(self)
        for name in ("_reached", "_filled", "_boxes"):
            other.__dict__.pop(name, None)
        other.widening = widening
        if self.robot.position_dim:
            other.reach = self._reach_for(widening)
            other.far = self.far or widening > 1.0  # the reach is that of tubes without it
        if tube is not self.tube:
            other.tube, other._first, other._base = tube, tube.first, self
            other._directions, other._first_stretch = tube.directions, float(tube.stretch[0])
            for name in ("discs", "limits"):
                other.__dict__.pop(name, None)
        return other

    def _reach_for(self, widening: float) -> float:
        """Return the radius [m] of local maps for tubes that are wider by a factor; no plan leaves it unnoticed."""
        return min(self.reach * widening, max(self.robot.sight, self.reach))

    @cached_property
    def discs(self) -> list[_Disc]:
        """Discs of the body, each with its tube."""
        return _discs(self.robot, self.tube, None if self._base is None else self._base.discs)

    @cached_property
    def limits(self) -> StateLimits | None:
        """The rows of the state limits, if the robot has any."""
        if not self.robot.limits:
            return None
        base = None if self._base is None else self._base.limits
        return StateLimits(self.robot, self.tube) if base is None else base.around(self.tube)

    @cached_property
    def _reached(self) -> tuple[Array, Array, Array, Array, Array, Array, float]:
        """The arguments of the kernels that are the same for all requests."""
        tube = self.tube
        return *self._sized, np.ascontiguousarray(tube.position), tube.offset, self._directions, self.widening

    @cached_property
    def _filled(self) -> tuple[Array, Array, Array, Array, Array, Array, Array, Array, float]:
        """The arguments of `filled_by_plans` that are the same for all requests."""
        tube, whole = self.tube, np.ascontiguousarray
        position, moved = whole(tube.position), whole(np.abs(tube.position[..., -self._free :]))
        sizes = whole(tube.W), self._W_free, whole(tube.M), tube.m_0
        return *sizes, position, tube.offset, moved, self._spans, self.widening

    @cached_property
    def _boxes(self) -> ReservationRows:
        return ReservationRows(self.tube.position, self.tube.offset, self.tube.directions)

    # --- what is known before any request ---------------------------------------------------------------------

    def _stays(self) -> bool:
        """Return whether a standing robot stays in place.

        A robot that hovers by an estimate may drift: its tube of standing then grows over a plan by more than the
        measurement error, and by more than a tenth of the body's radius.
        """
        nothing = self.robot.zero_input()
        state = self.robot.state_at_inputs(nothing)[list(self.robot.regressor)]
        z = np.concatenate([state, np.tile(nothing, 1 + self.robot.free_steps)])
        half = np.abs(self.tube.directions) @ self.tube.magnitudes(z)[: self.tube.generators]
        size = np.linalg.norm(half, axis=1)
        return bool(size[-1] - size[0] <= max(np.linalg.norm(self.measured), 0.1 * self.robot.footprint))

    def _widest(self, tube: Tube, domain: Array) -> float:
        """Return a distance [m] from the measured position that no tube, with the body, exceeds.

        It comes from interval arithmetic over the range of all regressors, so it is loose for error bounds with many
        rows W. For a rollout it is an estimate from extreme regressors; the filter checks the extent of each plan.
        """
        robot, F = self.robot, self.robot.free_steps
        low = np.concatenate([domain[0], np.tile(robot.low(), F)])
        high = np.concatenate([domain[1], np.tile(robot.high(), F)])
        z = np.maximum(np.abs(low), np.abs(high))
        sizes = tube.M @ (np.abs(tube.W) @ z) + tube.m_0
        way = np.abs(tube.position) @ z + np.abs(tube.directions) @ sizes[: tube.generators]
        if isinstance(self.tube, RolloutTube):
            extremes = np.random.default_rng(0).integers(0, 2, (EXTREMES, len(low)))
            with np.errstate(over="ignore", invalid="ignore"):  # far from the data a rollout may diverge
                way += np.nan_to_num(np.abs(self.tube.outputs(np.where(extremes, high, low))[0]), nan=np.inf).max(0)
            way = np.minimum(ROOM_FOR_STRETCH * way, robot.sight)
        return float(np.linalg.norm(way, axis=1).max() + self.body + sizes[tube.generators :].max())

    def extent(self, z: Array) -> float:
        """Return the distance [m] from the measured position to the farthest point of the body in the tube of z."""
        return tube_kernels.extent(*self._reached, z, self.body)

    # --- one request ---------------------------------------------------------------------------------------------

    def local_map(self, request: Request, z_0: Array, inputs: tuple[Array, Array]) -> LocalMap:
        """Return the map of a request. inputs: center and half-widths of a plan's free inputs after z_0."""
        d, robot = self.robot.position_dim, self.robot
        start, near = np.ascontiguousarray(request.state[:d]), request.obstacles
        heading = float(request.state[robot.heading]) if robot.heading is not None else 0.0
        turn = self.turn(heading)
        beyond, reach = robot.sight, self._reach_for(request.widening)
        if len(near):
            beyond, counts = self._parted(near.distance(start) - near.margin, beyond, reach)
            near = near.take(counts)
        moving = request.movers
        if moving is not None:
            beyond, counts = self._parted(moving.least_distance(start, robot.horizon * robot.period), beyond, reach)
            moving = moving.take(counts) if counts.any() else None
        other_reservations = request.other_reservations
        if other_reservations is not None:
            beyond, counts = self._parted(other_reservations.nearest(start), beyond, reach)
            other_reservations = other_reservations.take(counts) if counts.any() else None
        unseen: seen.OccupiedCells | shades.OccludedRegions | None = None
        if isinstance(request.scan, RangeImage):
            room = self._room(z_0, inputs, start, turn, request.widening)
            unseen = shades.occluded_regions(request.scan, room, self.body, start)
        elif request.scan is not None:
            unseen = self._unseen(request.scan, start, reach)
        return LocalMap(start, heading, turn, near, beyond, moving, unseen, other_reservations, request.widening)

    def _parted(self, away: Array, beyond: float, reach: float) -> tuple[float, NDArray[np.bool_]]:
        """Return the distance [m] of the nearest obstacle beyond reach, at most `beyond`, and which (n,) are within.

        An obstacle whose distance is NaN counts as within reach.
        """
        counts = ~(away > reach)
        return float(away[~counts].min(initial=beyond)), counts

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
            filled = self.at(z, widening)._filled
            boxes = halfspace_kernels.filled_by_plans(*filled, z, inputs[1], self._beside, start, turn)
        return shades.PlanBoxes(boxes, self.robot.horizon * self.robot.period)

    def _unseen(self, scan: Scan, start: Array, reach: float) -> seen.OccupiedCells | None:
        """Return the cells that a scan does not show to be free, within reach or able to come there during a plan."""
        within = reach + scan.speed * (scan.age + self.robot.horizon * self.robot.period)
        within += float(np.linalg.norm(scan.sensor()[0] - start)) + scan.sensor_error
        occupied_cells = seen.occupied_cells(scan, within + scan.heading_error * within)
        return occupied_cells if len(occupied_cells) else None

    def sets(self, start: Array, turn: Array, z: Array) -> tuple[Array, Array]:
        """Return centers and half-widths (N, d), world, of the boxes of the true positions at the periods' ends."""
        return tube_kernels.sets(*self._reached, z, np.ascontiguousarray(start, dtype=float), turn, self.measured)

    def predict(self, local_map: LocalMap, z: Array) -> Prediction:
        """Return the predicted set of the next measured state, all coordinates (docs/method.md §2)."""
        center, half = tube_kernels.next_state(
            *self._next,
            self._regressor(z),
            self._first,
            self.widening * self._first_stretch,
            np.ascontiguousarray(local_map.start),
            local_map.turn,
        )
        if self.robot.heading is not None:
            center[self.robot.heading] += local_map.heading
        return Prediction(center, half, local_map.heading)

    def margin(self, rows: ConstraintRows, z: Array) -> float:
        """Return the smallest slack [m, or the unit of a limit] of the rows for the exact tube of z."""
        return self.least(rows.bound - rows.support(self.tube, z), z)

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
        found = []
        for disc in self.discs:
            start, measured = local_map.start, self.measured
            if disc.aside:
                start, measured = start + local_map.turn @ disc.at, measured + disc.swing
            ends = tube_kernels.places(disc.position, disc.offset, z, start, local_map.turn)
            beside = []
            if len(local_map.near) or local_map.unseen is None:
                beside.append(half_spaces(local_map.near, start, ends, disc.radius, measured))
                if leaving:
                    beside[0] = half_spaces_leading_out(local_map.near, start, disc.radius, measured, beside[0])
            if local_map.moving is not None:
                beside.append(
                    swept_half_spaces(local_map.moving, start, ends, disc.radius, measured, self.robot.period)
                )
                self._let_pass(beside[-1][1])
            if local_map.unseen is not None:
                of = shades if isinstance(local_map.unseen, shades.OccludedRegions) else seen
                beside.append(of.half_spaces(local_map.unseen, start, ends, disc.radius, measured, self.robot.period))
                if isinstance(local_map.unseen, seen.OccupiedCells) and local_map.unseen.speed > 0.0:
                    self._let_pass(beside[-1][1])
            normals, offsets = beside[0] if len(beside) == 1 else map(np.concatenate, zip(*beside, strict=True))
            found.append(Planes(start, ends, normals, offsets, disc.radius, measured))
        return found

    def _let_pass(self, levels: Array) -> None:
        """Drop the half-spaces (n, N) of moving obstacles for periods in which the robot stands (passive safety, §8).

        A NaN stays NaN.
        """
        late = levels[:, self.stands :]
        late[late == late] = FARTHEST  # not of NaN

    def rows(self, local_map: LocalMap, z: Array, planes: list[Planes] | None = None) -> ConstraintRows:
        """Return the half-spaces of the plan with regressors z as rows, for the tube and for the outer tube of the QP.

        Both tubes have the same generators; only the magnitudes differ. planes: the half-spaces, if known already.
        """
        planes = planes or self.planes(local_map, z)
        discs = zip(self.discs, planes, strict=True)
        parts = [
            disc.layout.rows(self._turned(plane.normals, local_map), plane.offsets, self.widening)
            for disc, plane in discs
        ]
        return stack_rows(parts + self._further(local_map, z))

    def slack(self, local_map: LocalMap, z: Array, planes: list[Planes] | None = None) -> Array:
        """Return `bound - support` (rows,) of the same rows."""
        sizes = tube_kernels.magnitudes(*self._sized, z)
        if self.widening != 1.0:
            sizes *= self.widening
        found = [
            disc.layout.slack(self._turned(plane.normals, local_map), plane.offsets, sizes, z)
            for disc, plane in zip(self.discs, planes or self.planes(local_map, z), strict=True)
        ]
        found += [rows.bound - rows.support(self.tube, z) for rows in self._further(local_map, z)]
        return found[0] if len(found) == 1 else np.concatenate(found)

    def _turned(self, normals: Array, local_map: LocalMap) -> Array:
        """Turn normals from the world to the robot's frame."""
        return normals if self.robot.heading is None else normals @ local_map.turn

    def _further(self, local_map: LocalMap, z: Array) -> list[ConstraintRows]:
        """Return the rows of reservations and of state limits."""
        parts = []
        if local_map.other_reservations is not None:
            nominal = local_map.start + self.tube.centers(z) @ local_map.turn.T
            body = self.robot.footprint
            kept = reservation_half_spaces(local_map.other_reservations, local_map.start, nominal, body, self.measured)
            parts.append(self._boxes.rows(*kept, local_map.turn, self.widening))
        if self.limits is not None:
            parts.append(self.limits.rows(local_map.start, local_map.heading, local_map.turn, self.widening))
        return parts

    def worst_of(
        self, local_map: LocalMap, z: Array, slack: Array, planes: list[Planes], kept_off: Array
    ) -> BlockingConstraint:
        """Return the constraint that blocks the proposal with regressors z most. kept_off (rows,) [m]: margin of a row.

        The end of the sensor's range has the largest of these margins.
        """
        beyond = self.reach - self.extent(z) if self.far else np.inf
        short = slack - kept_off
        if not len(slack) or beyond - kept_off.max(initial=0.0) < short.min():
            return BlockingConstraint.nowhere(SIGHT, beyond, self.robot.period * self.robot.horizon)
        row = int(np.argmin(short))
        around = ConstraintSources(local_map.near, local_map.moving, local_map.unseen, local_map.other_reservations)
        return worst(row, max(float(slack[row]), -self.reach), self.robot, around, planes)

    def clear(self, request: Request, local_map: LocalMap, z: Array, margin: float) -> tuple[float, bool]:
        """Return the margin [m] for a report, and whether it is only a lower bound.

        An obstacle beyond reach decides nothing, but it may be nearest to the tube. Then the lower bound is its
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

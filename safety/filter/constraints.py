"""What is around a robot, as half-spaces that its tube is held against (docs/method.md §3, §8-§10)."""

from __future__ import annotations

import math
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
from brakeline.safety.filter.reachable_tube import Tube
from brakeline.safety.filter.recovery import escape_direction
from brakeline.safety.filter.request import Request
from brakeline.safety.filter.reservation import OtherReservations, ReservationRows, reservation_half_spaces
from brakeline.safety.filter.state_limits import StateLimits, stack_rows
from brakeline.safety.model.model_set import ModelSet, extra_coordinates
from brakeline.safety.perception import occluded_regions as shades
from brakeline.safety.perception import scan_free_space as seen

Array = NDArray[np.float64]

ASIDE = 0.5  # m beyond all plans: what a range image is looked at for, and so the largest margin that it tells


@dataclass(frozen=True)
class _Disc:
    """A disc of the body with the tube of its centre. at (d,): in the robot's frame; swing [m]: what an error of the
    measured heading adds to where it is."""

    at: Array
    radius: float
    swing: float
    position: Array
    layout: ObstacleRows

    @cached_property
    def aside(self) -> bool:
        """Is it not where the robot is?"""
        return bool(self.at.any() or self.swing)


def _discs(robot: Robot, tube: Tube) -> list[_Disc]:
    d, found = robot.position_dim, []
    after = len(extra_coordinates(robot)) - d * sum(disc.arm > 0.0 for disc in robot.body)
    for disc in robot.body:
        position, directions, swing = tube.position, tube.directions, 0.0
        if disc.arm and robot.heading is not None:
            position, directions = tube.more[:, after : after + d], tube.more_directions[:, after : after + d]
            swing = disc.arm * robot.measurement_bound[robot.heading]
            after += d
        whole = np.ascontiguousarray(position)
        found.append(_Disc(np.asarray(disc.at), disc.radius, swing, whole, ObstacleRows(position, directions)))
    return found


@dataclass(frozen=True)
class LocalMap:
    """start (d,): the measured position; turn (d, d): world from the frame of now; near: the obstacles that
    count; beyond [m]: no other that was told of is nearer, nor the end of sight."""

    start: Array
    heading: float
    turn: Array
    near: Shapes
    beyond: float
    moving: MovingObstacles | None = None  # that may meet the tube
    unseen: seen.OccupiedCells | shades.OccludedRegions | None = None  # what a scan does not show to be free
    other_reservations: OtherReservations | None = None  # to other robots

    @property
    def parked(self) -> LocalMap:
        """The same for one that stands: what moves, or may, may stand by, that is its own affair."""
        unseen = None if self.unseen is not None and self.unseen.speed > 0.0 else self.unseen
        return replace(self, moving=None, unseen=unseen)

    @property
    def away(self) -> Array | None:
        """A direction (d,), world, off what is nearest to the start; None: nothing is of which that can be told."""
        ways = [escape_direction(self.near, self.start)[None]] if len(self.near) else []
        if isinstance(self.unseen, seen.OccupiedCells):
            ways.append(self.start - self.unseen.corners.reshape(-1, len(self.start)))
        each = np.concatenate(ways or [np.zeros((0, len(self.start)))])
        return each[np.argmin(np.einsum("nd,nd->n", each, each))] if len(each) else None

    @property
    def empty(self) -> bool:
        return not len(self.near) and self.moving is None and self.unseen is None and self.other_reservations is None


def turning_extent(robot: Robot, tube: Tube) -> float:
    """The clearance margin [m] that a robot needs by default: as wide as the tube of moving in place ever gets, so that
    wherever the robot stopped it can still turn.

    Without it a robot may stop so close to an obstacle that no motion can be verified from there, for good.
    """
    in_place = np.where([not moves for moves in robot.translates], robot.high(), 0.0)
    state = robot.state_at_inputs(in_place)
    z = np.concatenate([state[list(robot.regressor)], in_place, np.tile(in_place, robot.free_steps)])
    sizes = tube.magnitudes(z)
    L, d = tube.generators, robot.position_dim
    directions = np.random.default_rng(0).normal(size=(64, d))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    width = np.abs(directions[:, None, None, :] @ tube.directions)[:, :, 0] @ sizes[:L]
    drift = np.abs((directions[:, None, None, :] @ tube.position)[:, :, 0] @ z)
    return float((width + drift).max() + sizes[L:].max())


class TubeConstraints:
    """A robot's tube, ready to be held against scenes."""

    def __init__(
        self,
        model: ModelSet,
        tube: Tube,
        outer: Tube,
        domain: Array,
        clearance_margin: float,
        reach: float | None = None,
    ) -> None:
        """tube: the model's; `outer`: the same over-approximated with fewer atoms; domain (2, r): of the recorded
        regressors; clearance_margin [m]: the distance from the tube to obstacles that the QP keeps; reach [m]: that of
        the scenes, by default what this tube needs."""
        robot = model.robot
        if robot.position_dim == 3:
            shades.prepare()
        self.robot, self.tube, self.stands = robot, tube, model.moving
        self.discs = _discs(robot, tube)
        free = len(robot.action_slew) * (robot.free_steps - robot.committed_steps)
        self._spans = np.abs(tube.directions)
        whole = np.ascontiguousarray
        W_free, moved = whole(np.abs(tube.W[:, -free:])), whole(np.abs(tube.position[..., -free:]))
        parts = whole(tube.W), W_free, whole(tube.M), tube.m_0, whole(tube.position), moved, whole(self._spans)
        self._filled = parts  # what `filled_by_plans` is told of the tube
        self._sized = whole(tube.W.T), whole(tube.M.T), tube.m_0  # and what its `magnitudes` are
        self._reached = *self._sized, whole(tube.position), whole(tube.directions)
        first, n = model.first, robot.state_dim
        transposed = whole(first.W.T), whole(first.M.T), whole(first.kappa.T)
        # What `next_state` is told of the first period.
        self._next = whole(first.C[:n]), *transposed, first.w, whole(np.abs(first.generators[:n]))
        self._regressor = model.first_regressor
        self.boxes = ReservationRows(tube.position, tube.directions)
        self.limits = StateLimits(robot, tube) if robot.limits else None
        self.measured = np.asarray(robot.measurement_bound[: robot.position_dim], dtype=float)
        self._unturned = np.eye(robot.position_dim)
        self.body = robot.footprint + float(np.linalg.norm(self.measured))  # m about where the center was measured
        self.clearance_margin = clearance_margin
        farthest = max((float(np.linalg.norm(disc.at)) for disc in self.discs), default=0.0)
        self._beside = self.measured + self.clearance_margin + ASIDE + farthest  # of a plan's sets, which is looked at
        self.stays = self._stays()
        self.widest = self._widest(outer, domain)
        wanted = self.widest + self.clearance_margin
        # m from the measured position: an obstacle beyond it decides nothing
        self.reach = min(wanted, robot.sight) if reach is None else reach
        self.far = wanted > robot.sight  # a tube may leave what can be seen: every candidate must be looked at

    # --- what is known before any request ---------------------------------------------------------------------

    def _stays(self) -> bool:
        """Is it, once it stands, where it stands? Who hovers by an estimate may go on drifting: then standing for a
        plan's length adds more to where it may be than a measurement's error, and than a tenth of its body."""
        nothing = self.robot.zero_input()
        state = self.robot.state_at_inputs(nothing)[list(self.robot.regressor)]
        z = np.concatenate([state, np.tile(nothing, 1 + self.robot.free_steps)])
        half = np.abs(self.tube.directions) @ self.tube.magnitudes(z)[: self.tube.generators]
        size = np.linalg.norm(half, axis=1)
        return bool(size[-1] - size[0] <= max(np.linalg.norm(self.measured), 0.1 * self.robot.footprint))

    def _widest(self, tube: Tube, domain: Array) -> float:
        """[m] from the robot's measured position: no plan's tube, with the body about it, goes beyond.

        By interval arithmetic over the box of all regressors, so wide for certificates whose atoms mix them.
        """
        robot, F = self.robot, self.robot.free_steps
        low = np.concatenate([domain[0], np.tile(robot.low(), F)])
        high = np.concatenate([domain[1], np.tile(robot.high(), F)])
        z = np.maximum(np.abs(low), np.abs(high))
        sizes = tube.M @ (np.abs(tube.W) @ z) + tube.m_0
        way = np.abs(tube.position) @ z + np.abs(tube.directions) @ sizes[: tube.generators]
        return float(np.linalg.norm(way, axis=1).max() + self.body + sizes[tube.generators :].max())

    def extent(self, z: Array) -> float:
        """[m] from the measured position to the farthest point that the body may reach under regressors z."""
        return tube_kernels.extent(*self._reached, z, self.body)

    # --- one scene ---------------------------------------------------------------------------------------------

    def scene(self, request: Request, z_0: Array, inputs: tuple[Array, Array]) -> LocalMap:
        """inputs: center and half-widths of what a plan's free inputs may be, after z_0."""
        d, robot = self.robot.position_dim, self.robot
        start, near = np.ascontiguousarray(request.state[:d]), request.obstacles
        heading = float(request.state[robot.heading]) if robot.heading is not None else 0.0
        turn = self.turn(heading)
        beyond = robot.sight
        if len(near):
            beyond, counts = self._parted(near.distance(start) - near.margin, beyond)
            near = near.take(counts)
        moving = request.movers
        if moving is not None:
            beyond, counts = self._parted(moving.least_distance(start, robot.horizon * robot.period), beyond)
            moving = moving.take(counts) if counts.any() else None
        other_reservations = request.other_reservations
        if other_reservations is not None:
            beyond, counts = self._parted(other_reservations.nearest(start), beyond)
            other_reservations = other_reservations.take(counts) if counts.any() else None
        unseen: seen.OccupiedCells | shades.OccludedRegions | None = None
        if isinstance(request.scan, RangeImage):
            unseen = shades.occluded_regions(request.scan, self._room(z_0, inputs, start, turn), self.body, start)
        elif request.scan is not None:
            unseen = self._unseen(request.scan, start)
        return LocalMap(start, heading, turn, near, beyond, moving, unseen, other_reservations)

    def _parted(self, away: Array, beyond: float) -> tuple[float, NDArray[np.bool_]]:
        """How near [m] the nearest beyond reach is, of these and what was looked at before, and which (n,) are within;
        one whose distance is no number is."""
        counts = ~(away > self.reach)
        return float(away[~counts].min(initial=beyond)), counts

    def turn(self, heading: float) -> Array:
        """(d, d), world from the frame of now."""
        if self.robot.heading is None:
            return self._unturned
        turn = self._unturned.copy()
        cos, sin = math.cos(heading), math.sin(heading)
        turn[0, 0], turn[0, 1], turn[1, 0], turn[1, 1] = cos, -sin, sin, cos
        return turn

    def _room(self, z_0: Array, inputs: tuple[Array, Array], start: Array, turn: Array) -> shades.PlanBoxes:
        """Boxes, world, in which every plan's discs stay with their middles after z_0; and some more."""
        z = np.concatenate([z_0, inputs[0]])
        return shades.PlanBoxes(
            halfspace_kernels.filled_by_plans(*self._filled, z, inputs[1], self._beside, start, turn),
            self.robot.horizon * self.robot.period,
        )

    def _unseen(self, scan: Scan, start: Array) -> seen.OccupiedCells | None:
        """What is not known to be free within reach, or may come there before a plan ends."""
        within = self.reach + scan.speed * (scan.age + self.robot.horizon * self.robot.period)
        within += float(np.linalg.norm(scan.sensor()[0] - start)) + scan.sensor_error
        occupied_cells = seen.occupied_cells(scan, within + scan.heading_error * within)
        return occupied_cells if len(occupied_cells) else None

    def sets(self, start: Array, turn: Array, z: Array) -> tuple[Array, Array]:
        """Where the true positions at the periods' ends lie, world: centers and half-widths (N, d)."""
        return tube_kernels.sets(*self._reached, z, np.ascontiguousarray(start, dtype=float), turn, self.measured)

    def predict(self, scene: LocalMap, z: Array) -> Prediction:
        """The set of the next measured state, all coordinates."""
        center, half = tube_kernels.next_state(
            *self._next, self._regressor(z), np.ascontiguousarray(scene.start), scene.turn
        )
        if self.robot.heading is not None:
            center[self.robot.heading] += scene.heading
        return Prediction(center, half, scene.heading)

    def margin(self, rows: ConstraintRows, z: Array) -> float:
        """Smallest distance [m] of the exact tube to a half-space (of a limit: in its own units)."""
        return self.least(rows.bound - rows.support(self.tube, z), z)

    def margin_in(self, scene: LocalMap, z: Array) -> float:
        """The same, to those about the rollout of regressors z."""
        return self.least(self.slack(scene, z), z)

    def least(self, slack: Array, z: Array, nearer: float = 0.0) -> float:
        """The smallest slack, within ± the reach (less `nearer`); NaN never counts as inside."""
        most = self.reach - nearer
        margin = halfspace_kernels.least(slack, most)
        if self.far:
            margin = min(margin, most - self.extent(z))
        return max(margin, -self.reach) if margin == margin else -self.reach

    def planes(self, scene: LocalMap, z: Array, leaving: bool = False) -> list[Planes]:
        """Half-spaces about the rollout of regressors z, of each disc of the body; leaving: where it is inside of an
        obstacle, those that lead out of it."""
        found = []
        for disc in self.discs:
            start, measured = scene.start, self.measured
            if disc.aside:
                start, measured = start + scene.turn @ disc.at, measured + disc.swing
            ends = tube_kernels.places(disc.position, z, start, scene.turn)
            beside = []
            if len(scene.near) or scene.unseen is None:
                beside.append(half_spaces(scene.near, start, ends, disc.radius, measured))
                if leaving:
                    beside[0] = half_spaces_leading_out(scene.near, start, disc.radius, measured, beside[0])
            if scene.moving is not None:
                beside.append(swept_half_spaces(scene.moving, start, ends, disc.radius, measured, self.robot.period))
                self._let_pass(beside[-1][1])
            if scene.unseen is not None:
                of = shades if isinstance(scene.unseen, shades.OccludedRegions) else seen
                beside.append(of.half_spaces(scene.unseen, start, ends, disc.radius, measured, self.robot.period))
                if isinstance(scene.unseen, seen.OccupiedCells) and scene.unseen.speed > 0.0:
                    self._let_pass(beside[-1][1])
            normals, offsets = beside[0] if len(beside) == 1 else map(np.concatenate, zip(*beside, strict=True))
            found.append(Planes(start, ends, normals, offsets, disc.radius, measured))
        return found

    def _let_pass(self, levels: Array) -> None:
        """Nothing is asked of half-spaces (n, N) beside what moves from when on the robot stands: what is promised is
        that it stands when it is touched. A level that is no number goes on to be none."""
        late = levels[:, self.stands :]
        late[late == late] = FARTHEST  # not of NaN

    def rows(self, scene: LocalMap, z: Array, planes: list[Planes] | None = None) -> ConstraintRows:
        """Half-spaces about the rollout of regressors z, as rows of the tube (and of the QP's: its generators are the
        same, only their magnitudes are not). planes: if they are known already."""
        planes = planes or self.planes(scene, z)
        discs = zip(self.discs, planes, strict=True)
        parts = [disc.layout.rows(self._turned(plane.normals, scene), plane.offsets) for disc, plane in discs]
        return stack_rows(parts + self._further(scene, z))

    def slack(self, scene: LocalMap, z: Array, planes: list[Planes] | None = None) -> Array:
        """What the same rows leave, `bound - support` (rows,)."""
        sizes = tube_kernels.magnitudes(*self._sized, z)
        found = [
            disc.layout.slack(self._turned(plane.normals, scene), plane.offsets, sizes, z)
            for disc, plane in zip(self.discs, planes or self.planes(scene, z), strict=True)
        ]
        found += [rows.bound - rows.support(self.tube, z) for rows in self._further(scene, z)]
        return found[0] if len(found) == 1 else np.concatenate(found)

    def _turned(self, normals: Array, scene: LocalMap) -> Array:
        """Into the frame of now."""
        return normals if self.robot.heading is None else normals @ scene.turn

    def _further(self, scene: LocalMap, z: Array) -> list[ConstraintRows]:
        """The rows that are not a disc's own."""
        parts = []
        if scene.other_reservations is not None:
            nominal = scene.start + self.tube.centers(z) @ scene.turn.T
            body = self.robot.footprint
            kept = reservation_half_spaces(scene.other_reservations, scene.start, nominal, body, self.measured)
            parts.append(self.boxes.rows(*kept, scene.turn))
        if self.limits is not None:
            parts.append(self.limits.rows(scene.start, scene.heading, scene.turn))
        return parts

    def worst_of(
        self, scene: LocalMap, z: Array, slack: Array, planes: list[Planes], kept_off: Array
    ) -> BlockingConstraint:
        """What the proposal, regressors z, comes nearest to; kept_off (rows,): so much nearer than it is each counts,
        and the end of sight as much as the most of them."""
        beyond = self.reach - self.extent(z) if self.far else np.inf
        short = slack - kept_off
        if not len(slack) or beyond - kept_off.max(initial=0.0) < short.min():
            return BlockingConstraint.nowhere(SIGHT, beyond, self.robot.period * self.robot.horizon)
        row = int(np.argmin(short))
        around = ConstraintSources(scene.near, scene.moving, scene.unseen, scene.other_reservations)
        return worst(row, max(float(slack[row]), -self.reach), self.robot, around, planes)

    def clear(self, request: Request, scene: LocalMap, z: Array, margin: float) -> tuple[float, bool]:
        """Smallest distance [m] of the tube to what is in sight, given that to what is within reach; True: it is only a
        lower bound.

        What is beyond the reach decides nothing, but it may be what is nearest to the tube. Of it the bound is told:
        how far it is, less how far the tube goes.
        """
        if isinstance(scene.unseen, shades.OccludedRegions) and margin >= ASIDE:
            return margin, True
        if not self.far and margin + self.widest <= self.reach:
            return margin, False
        extent = self.extent(z)
        if self.far:
            return margin, margin >= self.reach - extent
        if margin < self.reach and margin <= scene.beyond - extent:
            return margin, False
        # Of what is within reach no more is known than that; a scan was not looked at beyond it.
        most = self.robot.sight - self.widest if scene.empty and request.scan is None else self.reach
        return min(scene.beyond - extent, most), True

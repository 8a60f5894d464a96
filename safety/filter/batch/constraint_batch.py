"""A tube and the rows that the obstacles of a batch add to it: `TubeConstraints` for many robots; the batch is last."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, TypeVar

import numpy as np

from brakeline.safety.filter.batch.batch_tube import PathBatch, TubeBatch
from brakeline.safety.filter.batch.obstacle_arrays import Array, Axes, NearObstacles, TurnBatch, mapped
from brakeline.safety.filter.batch.plane_batch import EndBatch, PlaneBatch, planes_beside
from brakeline.safety.filter.constraints import TubeConstraints

T = TypeVar("T")


@dataclass(frozen=True)
class SceneBatch:
    """The surroundings of each robot of a batch: `LocalMap` for obstacles that stand still."""

    start: Axes  # per axis (B,), world
    turn: TurnBatch  # the rotations from the robots' frames to the world
    near: NearObstacles  # the obstacles within reach
    # (B,) [m]: the distance below which the request names no further obstacle, at most the sensor's range
    beyond: Array
    # widening, reach (B,): factor on every set of a plan, and radius of the map [m]
    widening: Array
    reach: Array
    far: Array  # (B,): a tube may leave the sensor's range
    # asked_widening, state_widening (B,): factors on the set of the next state, as in `LocalMap`
    asked_widening: Array
    state_widening: Array


@dataclass(frozen=True)
class PlanBatch:
    """A batch of plans with their tubes and the half-spaces around them."""

    z: Array  # (nz, B): regressors
    path: PathBatch  # predicted centers
    sizes: Array  # (L+N+1, B): magnitudes with widening
    planes: list[PlaneBatch]  # the half-spaces, for each disc of the body
    slack: Array  # (R, B) [m]: bound minus support of the rows of all half-spaces
    extent: Array  # (B,) [m]: distance from the measured position to the farthest point of the body in the tube


class ConstraintBatch:
    """The constraints of a tube, in a namespace and on a device. The arguments `scene` belong to the same lanes."""

    def __init__(self, constraints: TubeConstraints, constant: Any, xp: Any) -> None:
        robot, tube = constraints.robot, constraints.tube
        self._xp, self.d, self.N, self.L = xp, robot.position_dim, tube.horizon, tube.generators
        self.tube = TubeBatch(tube, robot.state_dim, constant, xp)
        self.measured = constraints.measured.tolist()
        self.body, self.sight, self.widest = constraints.body, robot.sight, constraints.widest
        self.base_far, self.clearance = constraints.far, constraints.clearance
        self._margin_half, self._margin_extra = constant(self.clearance.half), constant(self.clearance.extra)
        self.discs = []
        for disc in constraints.discs:
            at = disc.at.tolist() if disc.aside else None
            first = 0 if disc.among is None else self.d + disc.among.start
            measured = [part + disc.swing for part in self.measured]
            self.discs.append((at, disc.radius, measured, first, EndBatch(disc.layout.ends, constant, xp)))
        spans = np.abs(tube.directions)
        self._spans = constant(spans.reshape(-1, self.L))
        self._directions = [constant(np.ascontiguousarray(tube.directions[:, i, :, None])) for i in range(self.d)]

    # --- one batch of plans ----------------------------------------------------------------------------------------

    def around(self, scene: SceneBatch, z: Array, planes: list[PlaneBatch] | None = None) -> PlanBatch:
        """Return the plans with regressors z (nz, B). planes: the half-spaces; None: those around the plans."""
        path, sizes = self.tube.path(z), self.tube.sizes(z, scene.widening)
        if planes is None:
            planes = self._planes(scene, path)
        return PlanBatch(z, path, sizes, planes, self.slack(planes, path, sizes), self.extent(scene, path, sizes))

    def _planes(self, scene: SceneBatch, path: PathBatch) -> list[PlaneBatch]:
        planes = []
        for at, radius, measured, first, _ in self.discs:
            centers = [path.outputs[:, first + i] for i in range(self.d)]
            nominal = scene.turn.to_world(centers)
            start = scene.start
            if at is not None:
                start = [a + b for a, b in zip(start, scene.turn.to_world(at), strict=True)]
            planes.append(planes_beside(self._xp, scene.near, start, nominal, scene.turn, radius, measured))
        return planes

    def slack(self, planes: list[PlaneBatch], path: PathBatch, sizes: Array) -> Array:
        """Return the slack (R, B) of the half-spaces for the tubes, R = ends · obstacles · discs."""
        parts = []
        for (*_, first, ends), plane in zip(self.discs, planes, strict=True):
            positions = [path.outputs[:, first + i] for i in range(self.d)]
            part = ends.slack(plane, positions, path.stretch, sizes)
            parts.append(self._xp.reshape(part, (-1, part.shape[-1])))
        return parts[0] if len(parts) == 1 else self._xp.concat(parts)

    def kept_off(self, planes: list[PlaneBatch]) -> Array | float:
        """Return the clearance margin [m] of the same rows (R, B), or one number: `ClearanceMargin.of_rows`."""
        if self.clearance.whole_plan or not planes:
            return self.clearance.largest
        xp, parts = self._xp, []
        for plane in planes:
            last = [abs(part[-1])[None] for part in plane.normals]  # (1, K, B)
            per_box = sum(self._margin_half[:, i, None, None] * last[i] for i in range(self.d))
            margin = xp.max(per_box + self._margin_extra[:, None, None], axis=0)
            before = xp.zeros((2 * self.N * margin.shape[0], margin.shape[1]), dtype=margin.dtype, device=margin.device)
            parts += [before, margin]
        return xp.concat(parts)

    def extent(self, scene: SceneBatch, path: PathBatch, sizes: Array) -> Array:
        """Return bounds (B,) [m] on the distance of every point of the body from the start."""
        xp, L = self._xp, self.L
        width = xp.reshape(self._spans @ sizes[:L], (self.N, self.d, -1)) * path.stretch[:, None]
        corner = xp.abs(path.outputs[:, : self.d]) + width
        farthest = xp.sqrt(xp.max(xp.sum(corner * corner, axis=1), axis=0))
        return farthest + self.body + xp.max(sizes[L:], axis=0)

    def least(self, scene: SceneBatch, slack: Array, extent: Array, nearer: float = 0.0) -> Array:
        """Return the smallest slack (B,), limited to ± the reach (less `nearer`). NaN counts as the worst."""
        xp, most = self._xp, scene.reach - nearer
        margin = most if not slack.shape[0] else xp.minimum(most, xp.min(slack, axis=0))
        margin = xp.where(scene.far, xp.minimum(margin, most - extent), margin)
        return xp.where(margin >= -scene.reach, margin, -scene.reach)  # false for NaN

    def sets(self, scene: SceneBatch, plan: PlanBatch) -> tuple[Array, Array]:
        """Return centers and half-widths (N, d, B), world, of boxes of the true positions at the periods' ends."""
        xp, d, L = self._xp, self.d, self.L
        path, sizes = plan.path, plan.sizes[:L]
        moved = scene.turn.to_world([path.outputs[:, i] for i in range(d)])
        centers = [a + b for a, b in zip(scene.start, moved, strict=True)]
        half = []
        for measured, along in zip(self.measured, scene.turn.to_world(self._directions), strict=True):  # (N, L, B)
            half.append(measured + xp.sum(xp.abs(along) * sizes, axis=1) * path.stretch)
        return xp.stack(centers, axis=1), xp.stack(half, axis=1)

    def surface(
        self, scene: SceneBatch, plan: PlanBatch, disc: Array, which: Array, end: Array, when: Array
    ) -> tuple[Array, Array]:
        """Return the normals (d, B), world, of one half-space for each lane, and its point nearest to the disc's path.

        The half-space is at the surface of the obstacle, without the body's radius. disc, which, end (B,): indices of
        the disc, the obstacle and the end of a period; when (B,): the period's number.
        """
        xp, N, (K, B) = self._xp, self.N, scene.near.rho.shape
        period = xp.where(end < N, end, xp.minimum(end - N, xp.full_like(end, N - 1)))
        normal = xp.zeros((self.d, B), dtype=plan.extent.dtype, device=plan.extent.device)
        at = xp.zeros_like(normal)

        def one(part: Array) -> Array:
            """Pick the period and the obstacle of each lane from (N, K, B)."""
            return xp.take_along_axis(xp.reshape(part, (N * K, B)), (period * K + which)[None], axis=0)[0]

        margin = xp.take_along_axis(scene.near.margin, which[None], axis=0)[0]
        for number, ((offset, radius, measured, first, _), planes) in enumerate(
            zip(self.discs, plan.planes, strict=True)
        ):
            own = [one(part) for part in planes.normals]
            distance = xp.maximum(radius + margin, xp.zeros_like(margin))
            level = one(planes.offsets) + distance + sum(abs(own[i]) * measured[i] for i in range(self.d))
            path = xp.concat([xp.zeros_like(plan.path.outputs[:1]), plan.path.outputs])
            moved = [xp.take_along_axis(path[:, first + i], when[None], axis=0)[0] for i in range(self.d)]
            there = scene.turn.to_world(moved)
            gap = level - sum(own[i] * there[i] for i in range(self.d))
            start = scene.start
            if offset is not None:
                start = [a + b for a, b in zip(start, scene.turn.to_world(offset), strict=True)]
            for j in range(self.d):
                normal[j] = xp.where(disc == number, own[j], normal[j])
                at[j] = xp.where(disc == number, start[j] + there[j] + own[j] * gap, at[j])
        return normal, at

    def clear(self, scene: SceneBatch, plan: PlanBatch, margin: Array, empty: Array) -> tuple[Array, Array]:
        """Return the margins (B,) for a report, and whether each is only a lower bound: `TubeConstraints.clear`."""
        xp = self._xp
        most = xp.where(empty, self.sight - self.widest, scene.reach)
        exact = (margin < scene.reach) & (margin <= scene.beyond - plan.extent)
        near_ends = scene.far | (margin + self.widest <= scene.reach) | exact
        at_least = xp.where(scene.far, margin >= scene.reach - plan.extent, ~near_ends)
        return xp.where(near_ends, margin, xp.minimum(scene.beyond - plan.extent, most)), at_least


def taken(xp: Any, whole: T, lanes: Array) -> T:
    """Return some lanes, at least one, of a nested value whose arrays have the batch last.

    An array for all lanes, and None, stay as they are.
    """
    return mapped(whole, lambda part: xp.take(part, lanes, axis=-1) if part.shape[-1] != 1 else part)

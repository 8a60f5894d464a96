"""Half-spaces beside the obstacles of a batch, and their slack for a tube (docs/method.md §3); the batch is last.

The twin of `shape_kernels.planes_beside`, `shape_kernels.roomiest_planes` and `halfspace_kernels.slack`.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from brakeline.safety.filter.batch.obstacle_arrays import Array, Axes, NearObstacles, TurnBatch, towards
from brakeline.safety.filter.halfspaces import TOUCHING

UNUSED = 1e6  # m: offset of the half-space in an empty slot, which nothing ever comes near


class PlaneBatch(NamedTuple):
    """The half-spaces of one disc of the body: `a·(p - start) <= b`, one for each obstacle and period.

    Attributes:
        normals: per axis (N, K, B), world. turned: the same in the robot's frame.
        offsets (N, K, B) [m].
    """

    normals: Axes
    turned: Axes
    offsets: Array


def planes_beside(
    xp: Any, near: NearObstacles, start: Axes, nominal: Axes, turn: TurnBatch, keep_off: float, measured: Axes
) -> PlaneBatch:
    """Return the half-spaces for nominal paths.

    Args:
        xp: the namespace. near: the obstacles.
        start: per axis (B,), world. nominal: per axis (N, B), the way from the start to the periods' ends, world.
        turn: the rotations from the robots' frames to the world.
        keep_off [m], measured: per axis [m].
    """
    d, N = len(start), nominal[0].shape[0]
    ends = [xp.concat([xp.zeros_like(axis[:1]), axis]) for axis in nominal]  # (N + 1, B)
    between = [0.5 * (axis[:-1] + axis[1:]) for axis in ends]
    seen_from = []
    for i in range(d):  # the start, the middle of the first period, its end, ...
        pairs = xp.stack([ends[i][:-1], between[i]], axis=1)
        seen_from.append(xp.concat([xp.reshape(pairs, (2 * N, -1)), ends[i][-1:]]))
    way, gap = towards(xp, near, [a + s for a, s in zip(seen_from, start, strict=True)])
    far = gap > TOUCHING
    gap = xp.where(far, gap, TOUCHING)
    unit = [part / gap for part in way]
    level = sum(unit[i] * (way[i] + seen_from[i][:, None]) for i in range(d))
    level = xp.where(far & far[:1], level, -xp.inf)
    room = []
    for q in range(3):  # of the three planes of each period
        own = [part[q : q + 2 * N : 2] for part in unit]
        first, last = (sum(own[i] * ends[i][k : k + N, None] for i in range(d)) for k in (0, 1))
        room.append(level[q : q + 2 * N : 2] - xp.maximum(first, last))
    best01 = xp.where(room[1] > room[0], room[1], room[0])
    which = xp.where(room[2] > best01, 2, xp.where(room[1] > room[0], 1, 0))
    blocked = ~(xp.maximum(best01, room[2]) > 0.0)
    parts = [*unit, level]
    chosen = [
        xp.where(which == 2, part[2 : 2 + 2 * N : 2], xp.where(which == 1, part[1 : 1 + 2 * N : 2], part[: 2 * N : 2]))
        for part in parts
    ]
    _stay_in_force(xp, chosen, parts, blocked)
    *normals, offsets = chosen
    distance = xp.maximum(keep_off + near.margin, xp.zeros_like(near.margin))
    offsets = offsets - distance - sum(abs(normals[i]) * measured[i] for i in range(d))
    normals = [xp.where(near.used, part, 0.0) for part in normals]
    offsets = xp.where(near.used, offsets, UNUSED)
    return PlaneBatch(normals, turn.to_robot(normals), offsets)


def _stay_in_force(xp: Any, chosen: list[Array], parts: list[Array], blocked: Array) -> None:
    """From the first blocked period on, keep the plane of the period before; in the first one, that of the start."""
    if not bool(xp.any(blocked)):
        return
    through = blocked[0]
    for part, all_planes in zip(chosen, parts, strict=True):
        part[0] = xp.where(through, all_planes[0], part[0])
    for k in range(1, blocked.shape[0]):
        through = through | blocked[k]
        for part in chosen:
            part[k] = xp.where(through, part[k - 1], part[k])


class EndBatch:
    """The ends of a tube's periods for one disc, as `halfspace_kernels` has them, in a namespace and on a device."""

    def __init__(self, ends: tuple[Array, ...], constant: Any, xp: Any) -> None:
        """Prepare the arrays of `ObstacleRows`. constant: brings an array to the namespace and device."""
        end, period, directions, columns, extra = ends
        self._xp = xp
        self.count = len(end)
        self.period, self.extra = constant(period), constant(extra)  # (E,): see `halfspace_kernels`
        self.columns = [constant(np.ascontiguousarray(columns[:, k])) for k in range(columns.shape[1])]
        d = directions.shape[1]
        used = range(len(self.columns))
        self.directions = [[constant(directions[:, i, k][:, None, None]) for i in range(d)] for k in used]
        self.after = constant(np.maximum(end - 1, 0))
        self.moved = constant((end > 0).astype(float)[:, None])

    def at_ends(self, values: Array) -> Array:
        """Return values (N, ...) of the planes' periods at each end (E, ...)."""
        return self._xp.take(values, self.period, axis=0)

    def places(self, path: Array) -> Array:
        """Return the values (N, ...) after the periods at each end (E, ...); zero at the start."""
        picked = self._xp.take(path, self.after, axis=0)
        shape = (self.count, *(1,) * (picked.ndim - 1))
        return picked * self._xp.reshape(self.moved, shape)

    def alongs(self, normals: Axes, stretch: Array) -> list[Array]:
        """Return |a · generator| (E, K, B) for each column of generators. normals: at the ends, robot's frame."""
        factor = self._xp.take(stretch, self.after, axis=0)[:, None]
        spreads = []
        for directions in self.directions:
            along = sum(normals[i] * directions[i] for i in range(len(normals)))
            spreads.append(abs(along) * factor)
        return spreads

    def slack(self, planes: PlaneBatch, positions: Axes, stretch: Array, sizes: Array) -> Array:
        """Return the slack (E, K, B) of the half-spaces.

        Args:
            planes: the half-spaces. positions: per axis (N, B), in the robot's frame. stretch (N, B).
            sizes (L+N+1, B): the tube's magnitudes.
        """
        xp = self._xp
        normals = [self.at_ends(part) for part in planes.turned]
        left = self.at_ends(planes.offsets) - xp.take(sizes, self.extra, axis=0)[:, None]
        for normal, position in zip(normals, positions, strict=True):
            left = left - normal * self.places(position)[:, None]
        for along, columns in zip(self.alongs(normals, stretch), self.columns, strict=True):
            left = left - along * xp.take(sizes, columns, axis=0)[:, None]
        return left

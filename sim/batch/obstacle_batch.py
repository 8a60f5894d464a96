"""The static obstacles of many arenas as padded arrays: distances from points, and the ranges of rays."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from brakeline.messaging.obstacle import BOX, WALL, Array, Obstacle
from brakeline.messaging.task import ArenaKind
from brakeline.sim.arena import Arena
from brakeline.sim.mujoco_obstacles import geom_of

Rows = NDArray[np.intp]

WALLS = 4
FAR_AWAY = 1e6  # m, the place of the slots that hold nothing


class ObstacleBatch:
    """The obstacles of N arenas in the plane. A row of an array belongs to one arena, and has a slot for each obstacle.

    Attributes:
        shapes: the arrays of `Shapes`, with the row first: center (N, K, 2), axes (N, K, 2, 2), ...
        count (N,): number of slots in use.
    """

    def __init__(self, size: int, kind: ArenaKind) -> None:
        """Make room for the obstacles of `size` arenas of one kind."""
        self._discs, boxes = kind.cylinders[1], kind.boxes[1] + WALLS
        most = self._discs + boxes
        widths = {"center": (2,), "axes": (2, 2), "half": (2,), "rho": (), "round": (2,), "margin": ()}
        self.shapes: dict[str, Array] = {name: np.zeros((size, most, *width)) for name, width in widths.items()}
        self.count = np.zeros(size, dtype=np.int64)
        # What MuJoCo's rays hit. Its walls are boxes that end; those of `Shapes` are half-planes.
        self._disc, self._radius = np.full((size, self._discs, 2), FAR_AWAY), np.zeros((size, self._discs))
        self._box, self._half = np.full((size, boxes, 2), FAR_AWAY), np.zeros((size, boxes, 2))
        self._turn = np.tile([1.0, 0.0], (size, boxes, 1))  # cosine and sine of the yaw

    def put(self, row: int, arena: Arena) -> None:
        """Put the obstacles of an arena into a row."""
        count = self.count[row] = len(arena.obstacles)
        for name, array in self.shapes.items():
            array[row, :count] = getattr(arena.shapes, name)
        boxes = [obstacle for obstacle in arena.obstacles if obstacle.kind in (BOX, WALL)]
        discs = [obstacle for obstacle in arena.obstacles if obstacle.kind not in (BOX, WALL)]
        self._disc[row], self._box[row] = FAR_AWAY, FAR_AWAY
        for i, disc in enumerate(discs):
            self._disc[row, i], self._radius[row, i] = disc.position, disc.size[0]
        for i, box in enumerate(boxes):
            self._put_box(row, i, box, arena)

    def _put_box(self, row: int, slot: int, box: Obstacle, arena: Arena) -> None:
        _, half, position = geom_of(box, arena)
        self._box[row, slot], self._half[row, slot] = position[:2], half[:2]
        self._turn[row, slot] = np.cos(box.yaw), np.sin(box.yaw)

    def clearance(self, rows: Rows, points: Array) -> Array:
        """Return the distance (rows, P) [m] from points (rows, P, 2) to the nearest obstacle; 0 inside one."""
        center, axes, half, rho = (self.shapes[name][rows][:, None] for name in ("center", "axes", "half", "rho"))
        away = points[:, :, None] - center
        local = (away[..., None, :] @ axes)[..., 0, :]
        rest = np.abs(local) - half
        distance = np.hypot(*np.moveaxis(np.maximum(rest, 0.0), -1, 0)) - rho
        unused = np.arange(rho.shape[-1]) >= self.count[rows, None]
        return np.asarray(np.where(unused[:, None], np.inf, np.maximum(distance, 0.0)).min(axis=-1))

    def cast(self, rows: Rows, origins: Array, beams: Array, far: float) -> Array:
        """Return the range (rows, R) [m] of unit beams (rows, R, 2) from points (rows, 2), at most `far`.

        This is `Lidar.cast` for all rows.
        """
        nearest = np.minimum(self._at_discs(rows, origins, beams), self._at_boxes(rows, origins, beams))
        return np.minimum(nearest, far)

    def _at_discs(self, rows: Rows, origins: Array, beams: Array) -> Array:
        """Return the least distance (rows, R) to a disc along each beam: |origin + t beam - center| = radius."""
        if not self._discs:
            return np.full(beams.shape[:2], np.inf)
        away = self._disc[rows] - origins[:, None]  # (rows, D, 2)
        along = beams @ away.swapaxes(1, 2)  # (rows, R, D)
        square = np.einsum("nki,nki->nk", away, away) - self._radius[rows] ** 2
        under = along * along - square[:, None]
        root = np.sqrt(np.maximum(under, 0.0))
        return _first(along - root, along + root, under >= 0.0)

    def _at_boxes(self, rows: Rows, origins: Array, beams: Array) -> Array:
        """Return the least distance (rows, R) to a box along each beam, by the slabs between its faces."""
        cos, sin = self._turn[rows, :, 0], self._turn[rows, :, 1]  # (rows, K)
        away = origins[:, None] - self._box[rows]
        half = self._half[rows]
        enters, leaves = None, None
        for axis, (a, b) in enumerate(((cos, sin), (-sin, cos))):
            place = a * away[..., 0] + b * away[..., 1]
            way = beams[..., 0, None] * a[:, None] + beams[..., 1, None] * b[:, None]  # (rows, R, K)
            with np.errstate(divide="ignore", invalid="ignore"):
                inverse = 1.0 / way
                low, high = (-half[..., axis] - place)[:, None] * inverse, (half[..., axis] - place)[:, None] * inverse
            first, last = np.fmin(low, high), np.fmax(low, high)  # a beam along a face: NaN on one side only
            enters = first if enters is None else np.maximum(enters, first)
            leaves = last if leaves is None else np.minimum(leaves, last)
        assert enters is not None and leaves is not None
        return _first(enters, leaves, enters <= leaves)


def _first(enters: Array, leaves: Array, hits: NDArray[np.bool_]) -> Array:
    """Return the least distance over the last axis at which a beam enters a shape, or leaves the one it begins in."""
    distance = np.where(enters >= 0.0, enters, leaves)
    return np.asarray(np.where(hits & (distance >= 0.0), distance, np.inf).min(axis=-1))

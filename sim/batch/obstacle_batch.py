"""The static obstacles of many arenas as padded arrays: distances from points, and the ranges of rays."""

from __future__ import annotations

import numpy as np

from brakeline.messaging.arena_kinds import ArenaKind
from brakeline.messaging.obstacle import Array
from brakeline.sim.arena import Arena
from brakeline.sim.batch.normal_streams import Rows
from brakeline.sim.kernels.arena_kernels import distances_in_arenas
from brakeline.sim.kernels.ray_kernels import cast

FACES_IN_PLANE, FACES_IN_SPACE = 4, 6  # obstacles that bound a room


class ObstacleBatch:
    """The obstacles of N arenas in the plane or in space. A row of an array belongs to one arena."""

    def __init__(self, size: int, kind: ArenaKind) -> None:
        """Make room for the obstacles of `size` arenas of one kind."""
        d, faces = (2, FACES_IN_PLANE) if kind.height is None else (3, FACES_IN_SPACE)
        most = kind.cylinders[1] + kind.boxes[1] + kind.spheres[1] + faces
        widths = {"center": (d,), "axes": (d, d), "half": (d,), "rho": (), "round": (d,), "margin": ()}
        # the arrays of `Shapes`, with the row first: center (N, K, d), axes (N, K, d, d), ...
        self.shapes: dict[str, Array] = {name: np.zeros((size, most, *width)) for name, width in widths.items()}
        self.count = np.zeros(size, dtype=np.int64)  # (N,): number of the K slots in use

    def put(self, row: int, arena: Arena) -> None:
        count = self.count[row] = len(arena.obstacles)
        for name, array in self.shapes.items():
            array[row, :count] = getattr(arena.shapes, name)

    def clearance(self, rows: Rows, points: Array) -> Array:
        """Return the distance (rows, P) [m] from points (rows, P, d) to the nearest obstacle; 0 inside one."""
        return distances_in_arenas(*self._parts(), self.count, rows, np.ascontiguousarray(points))

    def cast(self, rows: Rows, origins: Array, beams: Array, far: float) -> Array:
        """Return the range (rows, R) [m] of unit beams (rows, R, d) from points (rows, d), at most `far`.

        This is `Lidar.cast` for all rows.
        """
        ranges = np.full(beams.shape[:2], far)
        cast(*self._parts(), self.count, rows, np.ascontiguousarray(origins), np.ascontiguousarray(beams), ranges)
        return ranges

    def _parts(self) -> tuple[Array, Array, Array, Array, Array]:
        """Return the arrays that compiled code takes, as `Shapes.parts`."""
        shapes = self.shapes
        return shapes["center"], shapes["axes"], shapes["half"], shapes["rho"], shapes["round"]

"""Obstacles as rounded boxes, and the distances from points to them, for many obstacles and points at once.

Every shape is `{c + R(yaw)(s + r)}`, s in the box |s_i| <= half_i, r in the disc (in x and y) or ball of radius rho:

    box       half, rho = 0
    cylinder  vertical; half = (0, 0, h), rho = radius, disc      (in the plane: a disc)
    sphere    half = 0, rho = radius, ball
    wall      the half-space behind a plane: a box of edge 2 WALL_DEPTH with one face in it

so one vectorised formula serves all. Shapes are convex: the closest point gives a supporting half-space.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from brakeline.messaging.obstacle_motion import Motion

Array = NDArray[np.float64]

# Whoever is within FARTHEST of the origin, as far as obstacles are, sees a wall of WALL_DEPTH as a half-space, and no
# obstacle as anything that rounding (1e-11 m there) or an overflow could make smaller than it is.
FARTHEST = 1e4  # m: of an obstacle's position from the origin along each axis, and its size
WALL_DEPTH = 1e5  # m; half the edge of the box that a wall is: more than anybody's distance from its middle
BOX, CYLINDER, SPHERE, WALL = "box", "cylinder", "sphere", "wall"
KINDS = (BOX, CYLINDER, SPHERE, WALL)


class BadShape(ValueError):
    """An obstacle that is none: `field` names what is wrong."""

    def __init__(self, field: str, message: str) -> None:
        super().__init__(message)
        self.field = field


@dataclass(frozen=True)
class Obstacle:
    """One obstacle, 2-D or 3-D by the length of `position`.

    size: box: full edge lengths (one per axis); cylinder: (radius,) in the plane, (radius, height) in space;
    sphere: (radius,); wall: () — a plane through `position` whose free side is the direction `yaw` points to.
    yaw: rad about the vertical (box and wall). margin: m that are kept beside the body's own radius; negative where the
    body may reach over it, down to minus its radius where only the regressed position counts.
    motion: how it moves; None: it stands still (`Shapes` takes every obstacle for standing: see `movers.split_moving`).
    """

    kind: str
    position: tuple[float, ...]
    size: tuple[float, ...] = ()
    yaw: float = 0.0
    margin: float = 0.0
    motion: Motion | None = None

    def __post_init__(self) -> None:
        if self.kind not in KINDS:
            raise BadShape("kind", f"no obstacle is called {self.kind!r}; there are: {', '.join(KINDS)}")
        dim = len(self.position)
        if dim not in (2, 3):
            raise BadShape("position", f"an obstacle's position has 2 or 3 coordinates, not {dim}")
        if not all(abs(value) <= FARTHEST for value in self.position):  # NaN fails too
            raise BadShape("position", f"an obstacle is within {FARTHEST:g} m, not at {list(self.position)}")
        if not math.isfinite(self.yaw):
            raise BadShape("yaw", f"an obstacle's yaw must be finite, not {self.yaw}")
        if not math.isfinite(self.margin):
            raise BadShape("margin", f"an obstacle's margin must be finite, not {self.margin}")
        sizes = {BOX: dim, CYLINDER: dim - 1, SPHERE: 1, WALL: 0}[self.kind]
        if len(self.size) != sizes:
            raise BadShape("size", f"a {dim}-D {self.kind} has {sizes} sizes, not {len(self.size)}")
        if not all(0.0 < value <= FARTHEST for value in self.size):
            raise BadShape(
                "size", f"the sizes of a {self.kind} are above 0 and up to {FARTHEST:g} m, not {list(self.size)}"
            )
        if self.motion is not None and (why := self.motion.wrong(dim)):
            raise BadShape("motion", why)


@dataclass(frozen=True)
class Shapes:
    """Obstacles as arrays: center (n, d), axes (n, d, d) world-from-local, half (n, d), rho (n,), round (n, d),
    margin (n,)."""

    center: Array
    axes: Array
    half: Array
    rho: Array
    round: Array  # 1 on the axes that the rounding acts on
    margin: Array  # m

    def __len__(self) -> int:
        return len(self.rho)

    @staticmethod
    def of(obstacles: Sequence[Obstacle], dim: int) -> Shapes:
        """Stack obstacles of one dimension. Raises BadShape when one has another dimension."""
        n, flat = len(obstacles), dim == 2
        center, axes, half, rho, rounded = [], [], [], [], []  # lists: filling arrays number by number costs more
        for i, obstacle in enumerate(obstacles):
            position, size = obstacle.position, obstacle.size
            if len(position) != dim:
                raise BadShape("position", f"obstacle {i} has {len(position)} coordinates, not {dim}")
            cos, sin = math.cos(obstacle.yaw), math.sin(obstacle.yaw)
            axes.append((cos, -sin, sin, cos) if flat else (cos, -sin, 0.0, sin, cos, 0.0, 0.0, 0.0, 1.0))
            extent, radius = (0.0,) * dim, 0.0
            upright = obstacle.kind == CYLINDER and not flat
            if obstacle.kind == BOX:
                extent = tuple(0.5 * edge for edge in size)
            elif obstacle.kind == WALL:
                extent = (WALL_DEPTH,) * dim
                position = (position[0] - WALL_DEPTH * cos, position[1] - WALL_DEPTH * sin, *position[2:])
            else:
                radius = size[0]
                extent = (0.0, 0.0, 0.5 * size[1]) if upright else extent
            center.append(position)
            half.append(extent)
            rho.append(radius)
            rounded.append((1.0, 1.0, 0.0) if upright else (1.0,) * dim)
        return Shapes(
            np.array(center, dtype=float).reshape(n, dim),
            np.array(axes, dtype=float).reshape(n, dim, dim),
            np.array(half, dtype=float).reshape(n, dim),
            np.array(rho, dtype=float),
            np.array(rounded, dtype=float).reshape(n, dim),
            np.array([obstacle.margin for obstacle in obstacles], dtype=float),
        )

    def kind(self, i: int) -> str:
        """What the i-th is; in the plane a disc is a cylinder."""
        if self.rho[i] > 0.0:
            return SPHERE if self.round.shape[1] == 3 and self.round[i].all() else CYLINDER
        return WALL if self.half[i, 0] >= WALL_DEPTH else BOX

    def take(self, index: NDArray[np.intp] | NDArray[np.bool_]) -> Shapes:
        """The chosen obstacles."""
        parts = self.center, self.axes, self.half, self.rho, self.round, self.margin
        return Shapes(*(part[index] for part in parts))

    def towards(self, points: Array) -> Array:
        """Vectors from points (..., d) to the closest points of the n obstacles: (n, ..., d); zero inside."""
        return self.each_towards(points.reshape(1, -1, points.shape[-1])).reshape(len(self), *points.shape)

    def each_towards(self, points: Array) -> Array:
        """The same of each from points of its own (n, points, d)."""
        local = (points - self.center[:, None]) @ self.axes
        half = self.half[:, None]
        rest = local - np.minimum(np.maximum(local, -half), half)
        rounded = rest * self.round[:, None]
        norm = np.sqrt(np.einsum("npi,npi->np", rounded, rounded))
        rest -= rounded * (self.rho[:, None] / np.maximum(norm, np.maximum(self.rho, 1e-300)[:, None]))[..., None]
        return np.asarray(-(rest @ self.axes.transpose(0, 2, 1)))

    def out_of(self, point: Array) -> Array:
        """Vectors (n, d) from a point (d,) inside of obstacles to the closest points of their surfaces; zero outside,
        and in the middle of what is round, from where every way is as long."""
        local = np.einsum("nji,nj->ni", self.axes, point - self.center)
        beside = local * self.round
        norm = np.sqrt(np.einsum("ni,ni->n", beside, beside))
        rounded = beside * ((self.rho - norm) / np.maximum(norm, 1e-300))[:, None]
        room = np.where(self.half > 0.0, self.half - np.abs(local), np.inf)  # to the flat faces
        face = room.argmin(axis=1)
        each = np.arange(len(self))
        flat = np.zeros_like(local)
        flat[each, face] = np.copysign(room[each, face], local[each, face])
        depth_flat, depth_round = room[each, face], np.where(self.rho > 0.0, self.rho - norm, np.inf)
        out = np.where((depth_flat < depth_round)[:, None], flat, rounded)
        inside = (np.minimum(depth_flat, depth_round) >= 0.0)[:, None]
        return np.asarray(np.einsum("nij,nj->ni", self.axes, np.where(inside, out, 0.0)))

    def distance(self, points: Array) -> Array:
        """Distances from points (..., d) to the n obstacles: (n, ...); 0 inside."""
        vector = self.towards(points)
        return np.asarray(np.sqrt(np.einsum("n...i,n...i->n...", vector, vector)))


def rotate(vectors: Array, angle: ArrayLike) -> Array:
    """Turn vectors (..., d >= 2) by `angle` (...) about the vertical."""
    cos, sin = np.cos(angle), np.sin(angle)
    turned = np.array(vectors)
    turned[..., 0] = cos * vectors[..., 0] - sin * vectors[..., 1]
    turned[..., 1] = sin * vectors[..., 0] + cos * vectors[..., 1]
    return turned

"""Obstacles as rounded boxes, with distances between many obstacles and points at once.

Each shape is `{c + R(yaw)(s + r)}` with s in the box |s_i| <= half_i, and r in the disc (in x and y) or ball of radius
rho:

    box       half, rho = 0
    cylinder  vertical; half = (0, 0, h), rho = radius, disc      (in the plane: a disc)
    sphere    half = 0, rho = radius, ball
    wall      the half-space behind a plane: a box of edge 2 WALL_DEPTH with one face in it

One vectorised formula covers all kinds. Shapes are convex: the closest point gives a supporting half-space.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from brakeline.errors import BadShape
from brakeline.messaging.obstacle_motion import Motion, freeze_vectors
from brakeline.messaging.value_equality import ComparedByValue

Array = NDArray[np.float64]

# For all positions within FARTHEST of the origin, a wall of WALL_DEPTH acts as a half-space, and rounding (1e-11 m) or
# overflow makes no obstacle smaller than it is.
FARTHEST = 1e4  # largest coordinate of an obstacle's position, and largest size [m]
WALL_DEPTH = 1e5  # half the edge of the box that represents a wall [m]
LARGEST = FARTHEST + WALL_DEPTH  # largest coordinate, size or margin in `Shapes` [m]
ORTHONORMAL = 1e-6  # largest error of the products of two axes in `Shapes`
BOX, CYLINDER, SPHERE, WALL = "box", "cylinder", "sphere", "wall"
KINDS = (BOX, CYLINDER, SPHERE, WALL)


@dataclass(frozen=True)
class Obstacle:
    """One obstacle in the plane or in space, by the length of `position`.

    Position and yaw are in the frame of the state's position, such as that of the map or the odometry. They are not in
    the robot's frame: transform an obstacle that a sensor on the robot saw, or give the filter a `Scan`.

    >>> Obstacle("cylinder", position=(0.4, 0.0), size=(0.1,)).kind
    'cylinder'

    Attributes:
        kind: box, cylinder, sphere or wall.
        position: center [m]; of a wall: a point on its surface.
        size: [m]; box: full edge lengths, one for each axis; cylinder: (radius,) in the plane, (radius, height) in
            space; sphere: (radius,); wall: ().
        yaw: rotation of a box about the vertical [rad]; of a wall: direction in which its free side lies.
        margin: extra clearance beyond the body's radius [m]. A negative margin, down to minus the body's radius, allows
            the body to overlap the obstacle.
        motion: None: the obstacle stands still. `Shapes` ignores motions; see `moving_obstacles.split_moving`.
    """

    kind: str
    position: tuple[float, ...]
    size: tuple[float, ...] = ()
    yaw: float = 0.0
    margin: float = 0.0
    motion: Motion | None = None

    def __post_init__(self) -> None:
        try:
            freeze_vectors(self, "position", "size")
            self._check()
        except BadShape:
            raise
        except (TypeError, ValueError, AttributeError) as error:  # a field has another type
            raise self._wrong_type() from error

    def _check(self) -> None:
        if self.kind not in KINDS:
            raise BadShape("kind", f"no obstacle is called {self.kind!r}; there are: {', '.join(KINDS)}")
        for name, values in (("position", self.position), ("size", self.size)):
            if not hasattr(values, "__len__"):
                raise BadShape(name, f"an obstacle's {name} is a tuple of numbers, such as (0.1,), not {values!r:.80}")
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
            raise BadShape("size", f"the size of a {dim}-D {self.kind} has length {sizes}, not {len(self.size)}")
        if not all(0.0 < value <= FARTHEST for value in self.size):
            raise BadShape(
                "size", f"the sizes of a {self.kind} are above 0 and up to {FARTHEST:g} m, not {list(self.size)}"
            )
        if self.motion is not None and (problem := self.motion.problem(dim)):
            raise BadShape("motion", problem)

    def _wrong_type(self) -> BadShape:
        """Return the error that names the first field without the numbers that belong there."""
        numbers = {"position": self.position, "size": self.size, "yaw": (self.yaw,), "margin": (self.margin,)}
        for name, values in numbers.items():
            if wrong := [value for value in values if not isinstance(value, int | float | np.number)]:
                return BadShape(name, f"an obstacle's {name} needs numbers, not {wrong[0]!r:.80}")
        return BadShape("motion", f"an obstacle's motion is a Motion of numbers or None, not {self.motion!r:.80}")


@dataclass(frozen=True, eq=False)
class Shapes(ComparedByValue):
    """n obstacles as arrays.

    >>> shapes = Shapes.of([Obstacle("box", (2.0, 0.0), (1.0, 1.0)), Obstacle("sphere", (3.0, 0.0), (1.0,))], dim=2)
    >>> shapes.distance(np.zeros(2)).tolist()
    [1.5, 2.0]

    Attributes:
        center: (n, d) [m].
        axes: rotations (n, d, d), world from local.
        half: half edge lengths of the boxes (n, d) [m].
        rho: rounding radii (n,) [m].
        round: (n, d), 1 on the axes along which the rounding acts.
        margin: (n,) [m].
    """

    center: Array
    axes: Array
    half: Array
    rho: Array
    round: Array
    margin: Array

    def __len__(self) -> int:
        return len(self.rho)

    @property
    def parts(self) -> tuple[Array, Array, Array, Array, Array]:
        """The arrays of the surfaces, without the margins, as compiled code needs them."""
        whole = np.ascontiguousarray
        return whole(self.center), whole(self.axes), whole(self.half), whole(self.rho), whole(self.round)

    @staticmethod
    def sizes(n: int, dim: int) -> dict[str, tuple[int, ...]]:
        """Return the shape that each array has for n obstacles in `dim` dimensions."""
        vectors, numbers = (n, dim), (n,)
        axes = (n, dim, dim)
        return {"center": vectors, "axes": axes, "half": vectors, "rho": numbers, "round": vectors, "margin": numbers}

    @staticmethod
    def of(obstacles: Sequence[Obstacle], dim: int) -> Shapes:
        """Stack obstacles that stand. `split_moving` separates them from those that move.

        Raises:
            BadShape: an obstacle has another dimension than `dim`, or a motion, which the arrays cannot hold.
        """
        if any(obstacle.motion is not None for obstacle in obstacles):
            raise BadShape("motion", "these arrays hold no motion: separate obstacles that move by split_moving")
        return Shapes.at_present(obstacles, dim)

    @staticmethod
    def at_present(obstacles: Sequence[Obstacle], dim: int) -> Shapes:
        """Stack obstacles where they are now, whether they move or not. Raises BadShape: one has another dimension."""
        n, flat = len(obstacles), dim == 2
        if n and not dim:
            raise BadShape("position", "a robot without a position has no obstacles, only limits")
        center, axes, half, rho, rounded = [], [], [], [], []  # lists: filling arrays one number at a time is slower
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
        """Return the kind of obstacle i; a disc in the plane is a cylinder."""
        if self.rho[i] > 0.0:
            return SPHERE if self.round.shape[1] == 3 and self.round[i].all() else CYLINDER
        return WALL if self.half[i, 0] >= WALL_DEPTH else BOX

    def take(self, index: NDArray[np.intp] | NDArray[np.bool_]) -> Shapes:
        """Return the selected obstacles."""
        parts = self.center, self.axes, self.half, self.rho, self.round, self.margin
        return Shapes(*(part[index] for part in parts))

    def towards(self, points: Array) -> Array:
        """Return vectors (n, ..., d) from points (..., d) to the closest points of each obstacle; zero inside."""
        return self.towards_from_own_points(points.reshape(1, -1, points.shape[-1])).reshape(len(self), *points.shape)

    def towards_from_own_points(self, points: Array) -> Array:
        """Return vectors (n, P, d) from each obstacle's own points (n, P, d) to the closest points of that obstacle."""
        local = (points - self.center[:, None]) @ self.axes
        half = self.half[:, None]
        rest = local - np.minimum(np.maximum(local, -half), half)
        rounded = rest * self.round[:, None]
        norm = np.sqrt(np.einsum("npi,npi->np", rounded, rounded))
        rest -= rounded * (self.rho[:, None] / np.maximum(norm, np.maximum(self.rho, 1e-300)[:, None]))[..., None]
        return np.asarray(-(rest @ self.axes.transpose(0, 2, 1)))

    def to_surface(self, point: Array) -> Array:
        """Return vectors (n, d) from a point (d,) inside obstacles to the closest points of their surfaces.

        A vector is zero if the point is outside, and at the center of a disc or ball, where no direction is closest.
        """
        local = np.einsum("nji,nj->ni", self.axes, point - self.center)
        radial = local * self.round
        norm = np.sqrt(np.einsum("ni,ni->n", radial, radial))
        to_round = radial * ((self.rho - norm) / np.maximum(norm, 1e-300))[:, None]
        room = np.where(self.half > 0.0, self.half - np.abs(local), np.inf)  # to the flat faces
        face = room.argmin(axis=1)
        rows = np.arange(len(self))
        to_flat = np.zeros_like(local)
        to_flat[rows, face] = np.copysign(room[rows, face], local[rows, face])
        depth_flat, depth_round = room[rows, face], np.where(self.rho > 0.0, self.rho - norm, np.inf)
        vectors = np.where((depth_flat < depth_round)[:, None], to_flat, to_round)
        inside = (np.minimum(depth_flat, depth_round) >= 0.0)[:, None]
        return np.asarray(np.einsum("nij,nj->ni", self.axes, np.where(inside, vectors, 0.0)))

    def distance(self, points: Array) -> Array:
        """Return distances (n, ...) from points (..., d) to each obstacle [m]; 0 inside."""
        vector = self.towards(points)
        return np.asarray(np.sqrt(np.einsum("n...i,n...i->n...", vector, vector)))


def rotate(vectors: Array, angle: ArrayLike) -> Array:
    """Rotate vectors (..., d >= 2) about the vertical by angles (...) [rad]."""
    cos, sin = np.cos(angle), np.sin(angle)
    rotated = np.array(vectors)
    rotated[..., 0] = cos * vectors[..., 0] - sin * vectors[..., 1]
    rotated[..., 1] = sin * vectors[..., 0] + cos * vectors[..., 1]
    return rotated

"""Obstacles that move, as arrays: many at once, as `Shapes` are."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from brakeline.messaging.obstacle import Obstacle, Shapes

Array = NDArray[np.float64]


@dataclass(frozen=True)
class MovingObstacles:
    """n obstacles with a motion: shapes as measured; drift (n, d) c [m/s]; growth (n, 3), r(t) = growth·(1, t, t²);
    age (n,) s since they were measured; kept (n,): not seen outside what the sighting before allows."""

    shapes: Shapes
    drift: Array
    growth: Array
    age: Array
    kept: NDArray[np.bool_]

    def __len__(self) -> int:
        return len(self.age)

    @staticmethod
    def of(obstacles: Sequence[Obstacle], dim: int) -> MovingObstacles:
        """Raises BadShape when one has another dimension; each has a motion."""
        n = len(obstacles)
        motions = [obstacle.motion for obstacle in obstacles if obstacle.motion is not None]
        pulls = [
            (m.velocity_error, 0.5 * (m.acceleration or 0.0)) if m.speed is None else (m.speed, 0.0) for m in motions
        ]
        growth = [(m.position_error, *pull) for m, pull in zip(motions, pulls, strict=True)]
        return MovingObstacles(
            Shapes.of(obstacles, dim),
            np.array([m.drift() for m in motions], dtype=float).reshape(n, dim),
            np.array(growth, dtype=float).reshape(n, 3),
            np.array([m.age for m in motions], dtype=float),
            np.array([m.kept(o.position) for m, o in zip(motions, obstacles, strict=True)], dtype=bool),
        )

    def take(self, index: NDArray[np.intp] | NDArray[np.bool_]) -> MovingObstacles:
        """The chosen ones."""
        return MovingObstacles(
            self.shapes.take(index), self.drift[index], self.growth[index], self.age[index], self.kept[index]
        )

    @cached_property
    def all_kept(self) -> bool:
        return bool(self.kept.all())

    def radius(self, times: Array) -> Array:
        """r (n, T) at so many seconds from now, (T,)."""
        t = self.age[:, None] + times
        return np.asarray(self.growth[:, :1] + self.growth[:, 1:2] * t + self.growth[:, 2:] * t * t)

    def moved(self, times: Array) -> Array:
        """Displacements c·t (n, T, d) from where they were measured."""
        return np.asarray(self.drift[:, None] * (self.age[:, None] + times)[..., None])

    def least_distance(self, point: Array, within: float) -> Array:
        """(n,) m: no point of them is nearer to a point (d,) than this at any time up to `within` s from now."""
        t = self.age + within
        way = np.sqrt(np.einsum("nd,nd->n", self.drift, self.drift)) * t
        way += self.growth[:, 0] + self.growth[:, 1] * t + self.growth[:, 2] * t * t
        return np.asarray(self.shapes.distance(point) - self.shapes.margin - way)


def split_moving(obstacles: Sequence[Obstacle], dim: int) -> tuple[Shapes, MovingObstacles | None]:
    """What stands still, and what moves (None: nothing). Raises BadShape."""
    moving = [obstacle for obstacle in obstacles if obstacle.motion is not None]
    if not moving:
        return Shapes.of(obstacles, dim), None
    return Shapes.of([o for o in obstacles if o.motion is None], dim), MovingObstacles.of(moving, dim)

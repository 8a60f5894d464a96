"""Moving obstacles as arrays, for computations on many obstacles at once (see `Shapes`)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from brakeline.messaging.obstacle import Array, Obstacle, Shapes
from brakeline.messaging.value_equality import ComparedByValue


@dataclass(frozen=True, eq=False)
class MovingObstacles(ComparedByValue):
    """n moving obstacles; `brakeline.messaging.obstacle_motion` has the equations."""

    shapes: Shapes  # as measured
    drift: Array  # c (n, d) [m/s]
    growth: Array  # (n, 3), r(t) = growth · (1, t, t²) [m]
    age: Array  # time since the measurement (n,) [s]
    consistent: NDArray[np.bool_]  # (n,), whether each measurement lies within the bounds of the previous one

    def __len__(self) -> int:
        return len(self.age)

    @staticmethod
    def of(obstacles: Sequence[Obstacle], dim: int) -> MovingObstacles:
        """Stack obstacles, each with a motion. Raises BadShape: an obstacle has another dimension than `dim`."""
        n = len(obstacles)
        motions = [obstacle.motion for obstacle in obstacles if obstacle.motion is not None]
        return MovingObstacles(
            Shapes.at_present(obstacles, dim),
            np.array([m.drift() for m in motions], dtype=float).reshape(n, dim),
            np.array([m.growth() for m in motions], dtype=float).reshape(n, 3),
            np.array([m.age for m in motions], dtype=float),
            np.array([m.is_consistent(o.position) for m, o in zip(motions, obstacles, strict=True)], dtype=bool),
        )

    def take(self, index: NDArray[np.intp] | NDArray[np.bool_]) -> MovingObstacles:
        return MovingObstacles(
            self.shapes.take(index), self.drift[index], self.growth[index], self.age[index], self.consistent[index]
        )

    def radius(self, times: Array) -> Array:
        """Return r (n, T) [m] at times from now (T,) [s]."""
        t = self.age[:, None] + times
        return np.asarray(self.growth[:, :1] + self.growth[:, 1:2] * t + self.growth[:, 2:] * t * t)

    def moved(self, times: Array) -> Array:
        """Return the displacements c·t (n, T, d) since the measurement [m] at times from now (T,) [s]."""
        return np.asarray(self.drift[:, None] * (self.age[:, None] + times)[..., None])

    def least_distance(self, point: Array, within: float, least_margin: float) -> Array:
        """Return a lower bound (n,) on the distance to a point (d,) at all times up to `within` seconds from now.

        The obstacles' margins are subtracted. One below `least_margin` [m] counts as that (`Robot.least_margin`).
        """
        t = self.age + within
        reach = np.sqrt(np.einsum("nd,nd->n", self.drift, self.drift)) * t
        reach += self.growth[:, 0] + self.growth[:, 1] * t + self.growth[:, 2] * t * t
        return np.asarray(self.shapes.distance(point) - np.maximum(self.shapes.margin, least_margin) - reach)


def split_moving(obstacles: Sequence[Obstacle], dim: int) -> tuple[Shapes, MovingObstacles | None]:
    """Return the standing obstacles and the moving ones (None if there are none).

    Raises:
        BadShape: an obstacle has another dimension than `dim`.
    """
    moving = [obstacle for obstacle in obstacles if obstacle.motion is not None]
    if not moving:
        return Shapes.of(obstacles, dim), None
    return Shapes.of([o for o in obstacles if o.motion is None], dim), MovingObstacles.of(moving, dim)

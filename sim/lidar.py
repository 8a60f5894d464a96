"""Simulate a lidar: ranges along a fan of beams, cast at the obstacles of an arena, with noise."""

from __future__ import annotations

import numpy as np

from brakeline.messaging.obstacle import Array, Shapes, rotate
from brakeline.messaging.ray_directions import LidarRays
from brakeline.sim.arena import Arena
from brakeline.sim.ground_estimator import cut_normal
from brakeline.sim.kernels.ray_kernels import cast


class Lidar:
    """One lidar in one arena. It sees the static and the moving obstacles of the arena, but not its own robot.

    Attributes:
        rays: the directions of the beams and their range.
        max_range: m, the value of a beam that hits nothing.
    """

    def __init__(
        self, arena: Arena, rays: LidarRays, noise: float = 0.0, rng: np.random.Generator | None = None
    ) -> None:
        """Mount the lidar, with the moving obstacles at their first positions.

        Args:
            rays: directions in the frame of the robot's heading, with the arena's dimension.
            noise: standard deviation of a range [m]; independent normal noise, truncated at two standard deviations.
            rng: the source of the noise. Without it, ranges are exact.
        """
        self.rays, self.max_range, self._noise, self._rng = rays, rays.range, noise, rng
        self._arena = arena
        self._obstacles = [part[None] for part in arena.shapes.parts]  # of one arena, as `cast` takes those of many
        self.move_obstacles(0.0)

    def move_obstacles(self, time: float) -> None:
        """Move the moving obstacles to their positions at a time [s]."""
        if self._arena.crowd is not None:
            moving = Shapes.of(self._arena.crowd.obstacles(max(time, 0.0)), self._arena.dim)
            pairs = zip(self._arena.shapes.parts, moving.parts, strict=True)
            self._obstacles = [np.concatenate(pair)[None] for pair in pairs]

    def cast(self, origin: Array, turn: float | Array = 0.0) -> Array:
        """Return the true ranges (R,) [m] from a point (d,) in free space.

        A beam that hits nothing within `max_range` has that value. From a point inside an obstacle, a beam ends where
        it leaves the obstacle.

        Args:
            origin: (d,) m.
            turn: from the robot's frame to the world: a heading [rad] or a rotation matrix (3, 3).
        """
        beams = self.rays.directions
        if isinstance(turn, np.ndarray):
            beams = beams @ turn.T
        elif turn:
            beams = rotate(beams, turn)
        ranges = np.full((1, len(beams)), self.max_range)
        center, axes, half, rho, rounded = self._obstacles
        count, row = np.array([center.shape[1]]), np.zeros(1, np.int64)
        point, ways = np.array(origin, float)[None], np.ascontiguousarray(beams)[None]
        cast(center, axes, half, rho, rounded, count, row, point, ways, ranges)
        return np.asarray(ranges[0])

    def ranges(self, origin: Array, turn: float | Array = 0.0) -> Array:
        """Return `cast` with noise, (R,) m in [0, max_range]; beams that hit nothing have none."""
        true = self.cast(origin, turn)
        if self._rng is None:
            return true
        noisy = true + cut_normal(self._rng, self._noise, true.shape)
        return np.where(true < self.max_range, np.clip(noisy, 0.0, self.max_range), self.max_range)

"""Simulate a lidar: ranges along a fan of beams, cast at the obstacles of an arena by MuJoCo, with noise."""

from __future__ import annotations

import mujoco
import numpy as np

from brakeline.messaging.obstacle import Array, rotate
from brakeline.messaging.ray_directions import LidarRays
from brakeline.sim.arena import Arena
from brakeline.sim.ground_estimator import cut_normal
from brakeline.sim.mujoco_obstacles import HEIGHT, MoverBodies, map_model


class Lidar:
    """One lidar in one arena. It sees the static and the moving obstacles of the arena, but not its own robot.

    Attributes:
        rays: the directions of the beams and their range.
        max_range: m, the value of a beam that hits nothing.
    """

    def __init__(
        self, arena: Arena, rays: LidarRays, noise: float = 0.0, rng: np.random.Generator | None = None
    ) -> None:
        """Build the model of the arena for ray casting.

        Args:
            rays: directions in the frame of the robot's heading, with the arena's dimension.
            noise: standard deviation of a range [m]; independent normal noise, truncated at two standard deviations.
            rng: the source of the noise. Without it, ranges are exact.
        """
        self.rays, self.max_range, self._noise, self._rng = rays, rays.range, noise, rng
        beams = np.zeros((len(rays.directions), 3))
        beams[:, : arena.dim] = rays.directions
        self._beams = beams
        self._height = 0.5 * HEIGHT if arena.dim == 2 else None
        self._model, self._data = map_model(arena)
        self._movers = MoverBodies(self._model, self._data, arena.crowd)
        self._hit, self._ranges = np.empty(len(beams), np.int32), np.empty(len(beams))

    def move_obstacles(self, time: float) -> None:
        """Move the moving obstacles to their positions at a time [s]."""
        if self._movers:
            self._movers.place(time)
            mujoco.mj_kinematics(self._model, self._data)

    def cast(self, origin: Array, turn: float | Array = 0.0) -> Array:
        """Return the true ranges (R,) [m] from a point (d,) in free space.

        A beam that hits nothing within `max_range` has that value. From a point inside an obstacle, a beam ends where
        it leaves the obstacle.

        Args:
            origin: (d,) m.
            turn: from the robot's frame to the world: a heading [rad] or a rotation matrix (3, 3).
        """
        if isinstance(turn, np.ndarray):
            beams = self._beams @ turn.T
        else:
            beams = rotate(self._beams, turn) if turn else self._beams
        point = origin if self._height is None else np.array([*origin, self._height])
        results = (self._hit, self._ranges, None)  # geoms, ranges, no normals
        # with all groups of geoms, static geoms too, and no body excluded
        mujoco.mj_multiRay(
            self._model, self._data, point, beams.ravel(), None, True, -1, *results, len(beams), self.max_range
        )
        return np.where((self._hit >= 0) & (self._ranges < self.max_range), self._ranges, self.max_range)

    def ranges(self, origin: Array, turn: float | Array = 0.0) -> Array:
        """Return `cast` with noise, (R,) m in [0, max_range]; beams that hit nothing have none."""
        true = self.cast(origin, turn)
        if self._rng is None:
            return true
        noisy = true + cut_normal(self._rng, self._noise, true.shape)
        return np.where(true < self.max_range, np.clip(noisy, 0.0, self.max_range), self.max_range)

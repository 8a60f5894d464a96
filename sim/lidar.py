"""Lidars: exact ranges along a fan of beams, cast at the obstacles of an arena by MuJoCo, with the sensor's noise."""

from __future__ import annotations

import mujoco
import numpy as np
from numpy.typing import NDArray

from brakeline.messaging.obstacle import rotate
from brakeline.messaging.ray_directions import LidarRays
from brakeline.sim.arena import Arena
from brakeline.sim.ground_estimator import cut_normal
from brakeline.sim.mujoco_obstacles import HEIGHT, MoverBodies, map_model

Array = NDArray[np.float64]


class Lidar:
    """One lidar in one arena. What it sees are the obstacles of the arena's map, and what moves there; robots are not
    among them."""

    def __init__(
        self, arena: Arena, rays: LidarRays, noise: float = 0.0, rng: np.random.Generator | None = None
    ) -> None:
        """rays: of the arena's dimension, in the frame of the robot's heading; noise: m, sigma of a range.

        The noise is normal, cut off at 2 sigma, anew each range; it needs `rng`.
        """
        self.rays, self.max_range, self._noise, self._rng = rays, rays.range, noise, rng
        beams = np.zeros((len(rays.directions), 3))
        beams[:, : arena.dim] = rays.directions
        self._beams = beams
        self._height = 0.5 * HEIGHT if arena.dim == 2 else None
        self._model, self._data = map_model(arena)
        self._moving = MoverBodies(self._model, self._data, arena.crowd)
        self._hit, self._ranges = np.empty(len(beams), np.int32), np.empty(len(beams))

    def at(self, time: float) -> None:
        """From now on what moves is seen where it is at that time, s."""
        if self._moving:
            self._moving.place(time)
            mujoco.mj_kinematics(self._model, self._data)

    def cast(self, origin: Array, turn: float | Array = 0.0) -> Array:
        """True ranges (R,) in m from a point (d,) of free space; `max_range` where nothing is hit within it.
        turn: of the robot's frame in the world, a heading [rad] or (3, 3).

        A point inside an obstacle has no true range: a beam then ends where it leaves the obstacle.
        """
        if isinstance(turn, np.ndarray):
            beams = self._beams @ turn.T
        else:
            beams = rotate(self._beams, turn) if turn else self._beams
        point = origin if self._height is None else np.array([*origin, self._height])
        mujoco.mj_multiRay(
            self._model,
            self._data,
            point,
            beams.ravel(),
            None,  # no groups of geoms
            True,  # geoms that can't move are seen
            -1,  # no body is left out
            self._hit,
            self._ranges,
            None,  # no normals
            len(beams),
            self.max_range,
        )
        return np.where((self._hit >= 0) & (self._ranges < self.max_range), self._ranges, self.max_range)

    def ranges(self, origin: Array, turn: float | Array = 0.0) -> Array:
        """What the lidar reports there, (R,) m in [0, max_range]; a beam that hits nothing reports `max_range`."""
        true = self.cast(origin, turn)
        if self._rng is None:
            return true
        noisy = true + cut_normal(self._rng, self._noise, true.shape)
        return np.where(true < self.max_range, np.clip(noisy, 0.0, self.max_range), self.max_range)

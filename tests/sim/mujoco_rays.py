"""The twin of `cast` in `sim/kernels/ray_kernels.py`: one ray of MuJoCo after the other."""

import mujoco
import numpy as np

from brakeline.messaging.obstacle import rotate
from brakeline.messaging.ray_directions import LidarRays
from brakeline.sim.arena import Arena
from brakeline.sim.mujoco_obstacles import HEIGHT, map_model


def mujoco_ranges(arena: Arena, rays: LidarRays, origin: np.ndarray, heading: float) -> np.ndarray:
    """Return the ranges (R,) [m] from a point (d,), at most those of the rays."""
    model, data = map_model(arena)
    point, beams = np.full(3, 0.5 * HEIGHT), np.zeros((len(rays.directions), 3))
    point[: arena.dim], beams[:, : arena.dim] = origin, rotate(rays.directions, heading)
    hit = np.zeros(1, np.int32)
    ranges = np.array([mujoco.mj_ray(model, data, point, beam, None, 1, -1, hit, None) for beam in beams])
    return np.minimum(np.where(ranges < 0.0, rays.range, ranges), rays.range)

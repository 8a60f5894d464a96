"""The twin of `first_fitting` in `sim/kernels/arena_kernels.py`, with NumPy: gaps between outlines in the plane."""

import numpy as np

from brakeline.messaging.obstacle import Obstacle, Shapes

CORNERS = np.array([(1.0, 1.0), (1.0, -1.0), (-1.0, 1.0), (-1.0, -1.0), (0.0, 0.0)])  # in half edges


def gaps(candidates: list[Obstacle], others: list[Obstacle]) -> np.ndarray:
    """Return the distance (k,) [m] from each candidate (in the plane, no wall) to the nearest other; overlap: <= 0."""
    ours, theirs = Shapes.of(candidates, dim=2), Shapes.of(others, dim=2)
    between = np.minimum(from_corners(ours, theirs), from_corners(theirs, ours).T)
    return (between - ours.rho[:, None] - theirs.rho).min(axis=1)


def from_corners(shapes: Shapes, others: Shapes) -> np.ndarray:
    """Return the least distance (k, o) [m] from the corners of each outline to the rectangle of each other."""
    corners = (CORNERS * shapes.half[:, None]) @ shapes.axes.swapaxes(1, 2) + shapes.center[:, None]
    away = (corners[:, None] - others.center[:, None]) @ others.axes
    beyond = np.maximum(np.abs(away) - others.half[:, None], 0.0)
    return np.sqrt((beyond * beyond).sum(axis=-1)).min(axis=-1)

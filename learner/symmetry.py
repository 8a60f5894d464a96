"""Augment transitions by their images in a turned or mirrored world.

The quadrotor's body, bounds, arenas and rays are invariant to a quarter turn about the vertical and to mirroring. With
a signed permutation R of the world's axes, a transition has the image

    ray j of s ↦ the ray i with e_i = Rᵀ e_j,      every vector v in s, and a,  ↦  R v

with the same reward and discount. A batch contains all eight images in equal shares.
"""

from __future__ import annotations

from itertools import product

import numpy as np
from numpy.typing import NDArray

from brakeline.learner.replay import NAMES, Batch
from brakeline.messaging.task import RobotWithTask

Indices = NDArray[np.intp]
Matrix = NDArray[np.float64]

TURNED = [NAMES.index(name) for name in ("observation", "action", "next_observation")]


def symmetry_matrices(robot: RobotWithTask) -> list[Matrix]:
    """Return the matrices R (d, d) to which a robot and its world are invariant, the identity first."""
    d = robot.position_dim
    if robot.task.symmetry == "none":
        return [np.eye(d)]
    swap = np.eye(d)[[1, 0, 2]]
    flips = [np.diag([x, y, 1.0]) for x, y in product((1.0, -1.0), repeat=2)]
    return [flip @ axes for axes in (np.eye(d), swap) for flip in flips]


def symmetry_maps(robot: RobotWithTask, turn: Matrix) -> tuple[Indices, Matrix, Indices, Matrix]:
    """Return the source and the sign of each coordinate of an observation's image, then those of an action's image.

    Raises:
        ValueError: the rays, or the other coordinates, are not invariant to the turn.
    """
    directions, d = robot.task.rays.directions, len(turn)
    alike = directions @ turn @ directions.T  # [j, i]: e_j · R e_i
    rays = alike.argmax(axis=1)
    if (alike.max(axis=1) < 1.0 - 1e-9).any():
        raise ValueError(f"the rays of {robot.name} are not the same after {turn.tolist()}")
    axes = np.abs(turn).argmax(axis=1)
    signs = turn[np.arange(d), axes]
    vectors, left = divmod(robot.task.observation_dim - len(rays), d)
    if left or robot.action_dim != d:
        raise ValueError(f"{robot.name} has coordinates besides vectors with {d} coordinates")
    after = len(rays) + (np.arange(vectors)[:, None] * d + axes).ravel()
    observed = np.concatenate([np.ones(len(rays)), np.tile(signs, vectors)])
    return np.concatenate([rays, after]), observed, axes, signs


class SymmetryAugmentation:
    """Replace row k of a batch by its image under matrix k of `symmetry_matrices`, modulo their number.

    The rows of a batch are drawn at random, so the image of a transition is random too.
    """

    def __init__(self, robot: RobotWithTask, batch: int) -> None:
        turns = symmetry_matrices(robot)
        if len(turns) == 1:
            self._sources: dict[int, tuple[Indices, NDArray[np.float32]]] = {}
            return
        images = [symmetry_maps(robot, turn) for turn in turns]
        which = np.arange(batch) % len(turns)
        observation, observed, action, acted = (np.array([image[part] for image in images])[which] for part in range(4))
        pair = np.hstack([observation, observation.shape[1] + action])
        self._sources = {
            columns.shape[1]: (_flat(columns), signs.astype(np.float32))
            for columns, signs in ((observation, observed), (action, acted), (pair, np.hstack([observed, acted])))
        }

    def apply(self, batch: Batch) -> None:
        """Replace a batch in place."""
        if self._sources:
            for number in TURNED:
                batch.arrays[number][:] = self.rows(batch.arrays[number])

    def rows(self, array: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return the images of observations (batch, o), actions (batch, m), or pairs of both (batch, o + m)."""
        if not self._sources:
            return array
        source, sign = self._sources[array.shape[1]]
        return np.asarray(np.take(array, source) * sign)


def _flat(columns: Indices) -> Indices:
    """Return columns (rows, width) as indices into the flat array of that shape."""
    rows, width = columns.shape
    return np.asarray(np.arange(rows)[:, None] * width + columns)

"""What a robot would have seen and done in a world that is turned or mirrored: as true as what was recorded.

The quadrotor's body, bounds, arenas and rays are the same after a quarter turn about the vertical, and in a mirror.
With a signed permutation R of the world's axes, a transition of it has the image

    ray j of s ↦ the ray i with e_i = Rᵀ e_j,      every vector v in s, and a,  ↦  R v

with the same reward and discount. A batch holds all eight images in equal shares: a policy need not learn the same
eight times.
"""

from __future__ import annotations

from itertools import product

import numpy as np
from numpy.typing import NDArray

from brakeline.learner.replay import Batch, ReplayBuffer
from brakeline.messaging.task import RobotWithTask

Indices = NDArray[np.intp]
Matrix = NDArray[np.float64]

OBSERVATION, ACTION, NEXT_OBSERVATION = (
    ReplayBuffer.NAMES.index(n) for n in ("observation", "action", "next_observation")
)


def symmetry_matrices(robot: RobotWithTask) -> list[Matrix]:
    """The R (d, d) under which a robot and its world stay the same, the identity first."""
    d = robot.position_dim
    if robot.task.symmetry == "none":
        return [np.eye(d)]
    swap = np.eye(d)[[1, 0, 2]]
    flips = [np.diag([x, y, 1.0]) for x, y in product((1.0, -1.0), repeat=2)]
    return [flip @ axes for axes in (np.eye(d), swap) for flip in flips]


def symmetry_maps(robot: RobotWithTask, turn: Matrix) -> tuple[Indices, Matrix, Indices, Matrix]:
    """Where each coordinate of an observation's image comes from, with which sign; the same of an action's.

    Raises:
        ValueError: the rays do not come upon each other.
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
        raise ValueError(f"{robot.name} observes and does more than vectors of {d} coordinates")
    after = len(rays) + (np.arange(vectors)[:, None] * d + axes).ravel()
    observed = np.concatenate([np.ones(len(rays)), np.tile(signs, vectors)])
    return np.concatenate([rays, after]), observed, axes, signs


class SymmetryAugmentation:
    """Replaces rows by their images: row k by that under number k of `symmetry_matrices`, modulo their count.

    Rows are drawn at random, so which image of a transition is seen is as random.
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
        """In place."""
        if self._sources:
            for number in (OBSERVATION, ACTION, NEXT_OBSERVATION):
                batch.arrays[number][:] = self.rows(batch.arrays[number])

    def rows(self, array: NDArray[np.float32]) -> NDArray[np.float32]:
        """Of observations (batch, o), actions (batch, m), or pairs of them (batch, o + m)."""
        if not self._sources:
            return array
        source, sign = self._sources[array.shape[1]]
        return np.asarray(np.take(array, source) * sign)


def _flat(columns: Indices) -> Indices:
    """Columns (rows, width) as indices into the array of that shape, laid out flat."""
    rows, width = columns.shape
    return np.asarray(np.arange(rows)[:, None] * width + columns)

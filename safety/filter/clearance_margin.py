"""The clearance margin: the distance that plans keep from obstacles beyond what safety needs (docs/method.md §4).

Without it a robot may stop so close to an obstacle that no motion can be verified from there.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from brakeline.messaging.robot import Array, Robot
from brakeline.safety.filter.blocking_constraint import Planes
from brakeline.safety.filter.halfspaces import rows_per_obstacle
from brakeline.safety.filter.reachable_tube import Tube
from brakeline.safety.model.model_set import ModelSet


@dataclass(frozen=True)
class ClearanceMargin:
    """The margin of each row (3), towards a half-space with normal a: the largest value of `half @ |a| + extra`.

    A robot with a heading turns, so its margin is the same in each direction, and holds during the whole plan. A robot
    without one must be able to stand where its plan ends: its margin is the support of the tube of standing, and holds
    at the plan's end only.

    Attributes:
        half (M, d): half-widths of the sets of a standing robot [m].
        extra (M,): chord deviation or stopping distance, which come on top in every direction [m].
        whole_plan: it holds during the whole plan.
        largest: the margin in the direction in which it is largest [m].
    """

    half: Array
    extra: Array
    whole_plan: bool
    largest: float

    @classmethod
    def of(cls, model: ModelSet, tube: Tube, given: float | None) -> ClearanceMargin:
        """Return the margin that is given [m], or else the one that the tube of turning in place needs.

        Raises ValueError: the margin is negative or not finite.
        """
        if given is None:
            return cls.of_standing(model, tube)
        if not 0.0 <= given < math.inf:  # NaN fails too
            raise ValueError(f"a clearance margin is a finite number of at least 0, not {given:g}")
        return cls.constant(model.robot, given)

    @classmethod
    def constant(cls, robot: Robot, margin: float) -> ClearanceMargin:
        """Return a margin [m] that is the same in each direction."""
        return cls(np.zeros((1, robot.position_dim)), np.array([margin]), robot.heading is not None, margin)

    @classmethod
    def of_standing(cls, model: ModelSet, tube: Tube) -> ClearanceMargin:
        """Return the margin that the tube of turning in place needs, at the highest turn rate.

        tube: of plans in place.
        """
        robot = model.robot
        if not robot.position_dim:
            return cls.constant(robot, 0.0)
        in_place = np.where([not moves for moves in robot.translates], robot.high(), 0.0)
        z = np.concatenate([model.measured_at(in_place), in_place, np.tile(in_place, robot.free_steps)])
        tube = tube.at(z)
        if robot.heading is not None:
            return cls.constant(robot, _turning_extent(robot, tube, z))
        half = np.abs(tube.centers(z)) + tube.half_widths(z)
        chord, stop = np.split(tube.magnitudes(z)[tube.generators :], [tube.horizon])
        # The rows of each period's start and end, and of the last end: `rows_per_obstacle`.
        starts = np.vstack([np.zeros((1, half.shape[1])), half[:-1]])
        half, extra = np.concatenate([starts, half, half[-1:]]), np.concatenate([chord, chord, stop])
        return cls(half, extra, False, float((np.linalg.norm(half, axis=1) + extra).max()))

    def of_rows(self, planes: list[Planes]) -> Array:
        """Return the margin (R,) [m] of the rows of half-spaces: disc by disc, obstacle by obstacle."""
        parts = []
        for disc in planes:
            n, N, _ = disc.normals.shape
            kept = np.full((n, rows_per_obstacle(N)), self.largest if self.whole_plan else 0.0)
            if not self.whole_plan:
                kept[:, -1] = (np.abs(disc.normals[:, -1]) @ self.half.T + self.extra).max(axis=1)
            parts.append(kept.ravel())
        return parts[0] if len(parts) == 1 else np.concatenate([np.zeros(0), *parts])


def _turning_extent(robot: Robot, tube: Tube, z: Array) -> float:
    """Return the extent [m] of the tube of z in the direction in which it is largest."""
    sizes = tube.magnitudes(z)
    L, d = tube.generators, robot.position_dim
    directions = np.random.default_rng(0).normal(size=(64, d))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    width = np.abs(directions[:, None, None, :] @ tube.directions)[:, :, 0] @ sizes[:L]
    drift = np.abs(directions @ tube.centers(z).T)
    return float((width + drift).max() + sizes[L:].max())

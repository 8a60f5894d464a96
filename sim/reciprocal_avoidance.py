"""How a robot that drives by a map gets past others that do the same: on the right, early, and if all stand, by trying
elsewhere.

Directions about the way ahead are compared by where each would lead while the others go on as they go now (van den
Berg's reciprocal velocity obstacles, sampled). Equals choose alike, so the right is a little cheaper than the left. Who
has hardly moved for `PATIENCE` periods drives aside to a place drawn at random, for a while: chance ends what symmetry
holds.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from brakeline.messaging.robot import Robot
from brakeline.sim.grid_planner import ClearanceMap

Array = NDArray[np.float64]

OFFSETS = np.radians(np.array([0, -12, 12, -24, 24, -36, 36, -50, 50, -70, 70, -95, 95, -130, 130, 180], dtype=float))
LEFT = 0.08  # rad that a turn to the left costs more
TURNING = 0.25  # of the angle that it has to turn: it does not waver between two ways that are alike
HORIZON = 6.0  # s
BERTH = 0.14  # m beside the two bodies: what the filter keeps between them, and some
SOON = 4.0  # rad·s: cost of meeting somebody, over the time until then
BESIDE = 0.04  # m beside the body that must be free along a direction
AHEAD = np.linspace(0.1, 0.8, 8)  # m, where that is looked at
BLOCKED = 10.0  # rad
PATIENCE = 40  # periods; turning round on the spot takes 32
MOVED = 0.08  # m; less in that time is standing
ASIDE = (0.4, 1.0)  # m
TRIES = 12


class ReciprocalAvoidance:
    """Of one robot in one episode."""

    def __init__(self, robot: Robot, grid: ClearanceMap, rng: np.random.Generator) -> None:
        self._robot, self._grid, self._rng = robot, grid, rng
        self._been: list[Array] = []
        self._aside: Array | None = None
        self._left = 0  # periods that it still drives aside

    def direction(self, state: Array, target: Array, others: Array) -> float:
        """Where to drive (rad, world) on the way to a target (2,); others: measured states (k, n)."""
        position = state[:2]
        self._been = [*self._been[-PATIENCE + 1 :], position.copy()]
        if self._left:
            self._left -= 1
        elif len(self._been) == PATIENCE and np.linalg.norm(position - self._been[0]) < MOVED:
            self._aside, self._left = self._place(position), int(self._rng.integers(PATIENCE // 2, PATIENCE))
            self._been.clear()
        if self._left and self._aside is not None:
            target = self._aside
        wanted = float(np.arctan2(target[1] - position[1], target[0] - position[0]))
        directions = wanted + OFFSETS
        unit = np.column_stack([np.cos(directions), np.sin(directions)])
        cost = TURNING * np.abs(np.remainder(directions - state[2] + np.pi, 2.0 * np.pi) - np.pi)
        cost += np.abs(OFFSETS) + LEFT * (OFFSETS > 0.0) + self._meeting(position, unit, others)
        line = position + AHEAD[:, None, None] * unit
        cost += BLOCKED * (self._grid.at(line) < self._robot.footprint + BESIDE).mean(axis=0)
        return float(directions[np.argmin(cost)])

    def _meeting(self, position: Array, unit: Array, others: Array) -> Array:
        """What each direction (C, 2) costs for whom it would meet, (C,)."""
        speed, berth = self._robot.high()[0], 2.0 * self._robot.footprint + BERTH
        away = others[:, :2] - position  # (k, 2)
        theirs = others[:, 3:4] * np.column_stack([np.cos(others[:, 2]), np.sin(others[:, 2])])
        room_boundary = speed * unit[:, None] - theirs  # (C, k, 2)
        square = np.maximum(np.einsum("cki,cki->ck", room_boundary, room_boundary), 1e-9)
        along = np.einsum("cki,ki->ck", room_boundary, away)
        gap = np.einsum("ki,ki->k", away, away) - berth**2
        inside = along**2 - square * gap  # discriminant of |away - closing t| = berth
        first = (along - np.sqrt(np.maximum(inside, 0.0))) / square
        meets = (inside > 0.0) & (along > 0.0) & (first < HORIZON)
        cost = np.where(meets, SOON / (np.maximum(first, 0.0) + 0.5) - SOON / (HORIZON + 0.5), 0.0)
        return np.asarray(cost.max(axis=1, initial=0.0))

    def _place(self, position: Array) -> Array:
        """One near by, with a free way to it if there is one."""
        place = position
        for _ in range(TRIES):
            angle, way = self._rng.uniform(-np.pi, np.pi), self._rng.uniform(*ASIDE)
            place = position + way * np.array([np.cos(angle), np.sin(angle)])
            line = position + np.linspace(0.2, 1.0, 6)[:, None] * (place - position)
            if (self._grid.at(line) > self._robot.footprint + 2.0 * BESIDE).all():
                return place
        return place

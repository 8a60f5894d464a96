"""Avoid other robots that drive by the same rules: pass early and on the right, and resolve deadlocks at random.

The robot samples directions around its path and compares them, assuming that the others keep their velocities (van den
Berg's reciprocal velocity obstacles). Equal robots choose alike, so a turn to the right costs a little less than one to
the left. A robot that has hardly moved for `PATIENCE` periods drives aside to a random position for a while: chance
resolves the deadlock of a symmetric situation.
"""

from __future__ import annotations

import numpy as np

from brakeline.messaging.obstacle import Array
from brakeline.messaging.robot import Robot
from brakeline.sim.grid_planner import ClearanceMap

OFFSETS = np.radians(np.array([0, -12, 12, -24, 24, -36, 36, -50, 50, -70, 70, -95, 95, -130, 130, 180], dtype=float))
LEFT_COST = 0.08  # rad, extra cost of a turn to the left
TURN_COST = 0.25  # cost per angle from the heading: without it the robot wavers between two equal directions
HORIZON = 6.0  # s, later encounters do not count
BODY_GAP = 0.14  # m between two bodies: the distance that the filter keeps, and some more
ENCOUNTER_COST = 4.0  # rad·s, cost of an encounter, divided by the time until it
SIDE_GAP = 0.04  # m beside the body that must be free along a direction
AHEAD = np.linspace(0.1, 0.8, 8)  # m, positions along a direction where the gap is checked
BLOCKED_COST = 10.0  # rad
PATIENCE = 40  # periods; turning round on the spot takes 32
LEAST_MOTION = 0.08  # m; a robot that moves less in that time is in a deadlock
ASIDE_DISTANCE = (0.4, 1.0)  # m
TRIES = 12


class ReciprocalAvoidance:
    """The avoidance of one robot in one episode."""

    def __init__(self, robot: Robot, grid: ClearanceMap, rng: np.random.Generator) -> None:
        self._robot, self._grid, self._rng = robot, grid, rng
        self._recent: list[Array] = []  # positions
        self._aside: Array | None = None
        self._left = 0  # periods of driving aside

    def direction(self, state: Array, target: Array, others: Array) -> float:
        """Return the direction [rad, world] to drive towards a target (2,). others: (k, n) measured states."""
        position = state[:2]
        self._recent = [*self._recent[-PATIENCE + 1 :], position.copy()]
        if self._left:
            self._left -= 1
        elif len(self._recent) == PATIENCE and np.linalg.norm(position - self._recent[0]) < LEAST_MOTION:
            self._aside, self._left = self._position_aside(position), int(self._rng.integers(PATIENCE // 2, PATIENCE))
            self._recent.clear()
        if self._left and self._aside is not None:
            target = self._aside
        wanted = float(np.arctan2(target[1] - position[1], target[0] - position[0]))
        directions = wanted + OFFSETS
        unit = np.column_stack([np.cos(directions), np.sin(directions)])
        cost = TURN_COST * np.abs(np.remainder(directions - state[2] + np.pi, 2.0 * np.pi) - np.pi)
        cost += np.abs(OFFSETS) + LEFT_COST * (OFFSETS > 0.0) + self._encounter_cost(position, unit, others)
        line = position + AHEAD[:, None, None] * unit
        cost += BLOCKED_COST * (self._grid.at(line) < self._robot.footprint + SIDE_GAP).mean(axis=0)
        return float(directions[np.argmin(cost)])

    def _encounter_cost(self, position: Array, unit: Array, others: Array) -> Array:
        """Return the cost (C,) of the encounters along each direction (C, 2)."""
        speed, berth = self._robot.high()[0], 2.0 * self._robot.footprint + BODY_GAP
        away = others[:, :2] - position  # (k, 2)
        theirs = others[:, 3:4] * np.column_stack([np.cos(others[:, 2]), np.sin(others[:, 2])])
        relative = speed * unit[:, None] - theirs  # (C, k, 2)
        square = np.maximum(np.einsum("cki,cki->ck", relative, relative), 1e-9)
        along = np.einsum("cki,ki->ck", relative, away)
        gap = np.einsum("ki,ki->k", away, away) - berth**2
        inside = along**2 - square * gap  # discriminant of |away - relative·t| = berth
        first = (along - np.sqrt(np.maximum(inside, 0.0))) / square
        meets = (inside > 0.0) & (along > 0.0) & (first < HORIZON)
        cost = np.where(meets, ENCOUNTER_COST / (np.maximum(first, 0.0) + 0.5) - ENCOUNTER_COST / (HORIZON + 0.5), 0.0)
        return np.asarray(cost.max(axis=1, initial=0.0))

    def _position_aside(self, position: Array) -> Array:
        """Draw a position nearby, with a free line to it if one is found."""
        place = position
        for _ in range(TRIES):
            angle, way = self._rng.uniform(-np.pi, np.pi), self._rng.uniform(*ASIDE_DISTANCE)
            place = position + way * np.array([np.cos(angle), np.sin(angle)])
            line = position + np.linspace(0.2, 1.0, 6)[:, None] * (place - position)
            if (self._grid.at(line) > self._robot.footprint + 2.0 * SIDE_GAP).all():
                return place
        return place

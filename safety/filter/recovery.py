"""Recovery: a slow way out for a robot whose standing cannot be verified (docs/method.md §11).

The candidates are slow inputs, each followed by braking. A candidate must not violate any row more than standing does.
Of these, recovery takes the one with the lexicographically smallest violations at the end of the plan, the worst first.
If there is none, a robot with a heading turns on the spot towards the open side. Recovery is never verified.
"""

from __future__ import annotations

import math
from itertools import product

import numpy as np
from numpy.typing import NDArray

from brakeline.messaging.obstacle import Shapes
from brakeline.messaging.robot import Array, Robot

SLOW = 0.3  # of the range of inputs that move the robot
BETTER = 1e-4  # m; a smaller difference does not count
COMPARED = 4  # violations, the worst first
MOST_COMBINED = 4  # inputs; of more, each is tried by itself, since the combinations would be too many


def slow_inputs(robot: Robot) -> Array:
    """Return all combinations (C, m) of slow backward, zero and slow forward inputs within bounds.

    In joint space with more than `MOST_COMBINED` inputs, only one input at a time differs from zero.
    """
    share = np.where(robot.translates, SLOW, 1.0)
    levels = [
        sorted({float(low), min(max(0.0, low), high), float(high)})
        for low, high in zip(share * robot.low(), share * robot.high(), strict=True)
    ]
    if not robot.position_dim and len(levels) > MOST_COMBINED:
        rest = robot.zero_input()
        alone = np.array([rest] + [rest] * sum(map(len, levels)))
        places = [(i, value) for i, values in enumerate(levels) for value in values]
        for row, (i, value) in enumerate(places, start=1):
            alone[row, i] = value
        return alone
    return np.array(list(product(*levels)))


def least_violating(violated: Array, standing: Array, ends: NDArray[np.bool_]) -> int | None:
    """Return the index of the best candidate, or None if no candidate is better than standing.

    violated (C, R): violation e [m] of each row by each candidate. standing (R,): by standing. ends (R,): rows at the
    end of the plan.
    """
    now = np.sort(np.maximum(standing[ends], 0.0))[::-1][:COMPARED]
    worst = -np.sort(-np.maximum(violated[:, ends], 0.0), axis=1)[:, :COMPARED]
    best: int | None = None
    for c in np.flatnonzero(harmless(violated, standing)):
        than = now if best is None else worst[best]
        if lexicographically_less(worst[c], than):
            best = int(c)
    return best


def harmless(violated: Array, standing: Array) -> NDArray[np.bool_]:
    """Return the candidates (C,) that violate no row more than standing does: e_i <= max(e_i⁰, 0) for every row i."""
    return np.asarray((violated <= np.maximum(standing, 0.0) + 1e-9).all(axis=1))


def lexicographically_less(one: Array, other: Array) -> bool:
    """Return whether the first of two sequences is lexicographically smaller, by more than `BETTER`."""
    for a, b in zip(one, other, strict=True):
        if abs(a - b) > BETTER:
            return bool(a < b)
    return False


def escape_direction(near: Shapes, start: Array) -> Array:
    """Return the direction (d,) away from the nearest obstacle, or out of the obstacle that the start is deepest in."""
    out = near.to_surface(start)
    depth = np.einsum("nd,nd->n", out, out)
    if depth.any():
        return np.asarray(out[np.argmax(depth)])
    ways = near.towards(start)
    return np.asarray(-ways[np.argmin(np.einsum("nd,nd->n", ways, ways))])


def turn_towards(robot: Robot, heading: float, away: Array) -> Array:
    """Return the input (m,) that turns on the spot towards a direction (d,), world."""
    error = math.remainder(math.atan2(away[1], away[0]) - heading, math.tau)
    wanted = np.where(robot.translates, 0.0, error / robot.period)
    return np.clip(wanted, robot.low(), robot.high())

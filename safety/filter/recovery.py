"""Out of where nothing can be verified, not even standing (docs/method.md §11).

Of slow inputs, each followed by braking, the one whose worst violated half-space is violated least at the plan's end,
then the next worst, and so on; none may violate any half-space more than standing does. What is compared is where they
lead, with the width of standing's tube. A robot that has to turn first turns on the spot towards where it can get away.
Of an obstacle that it is inside of (a margin below zero lets the body overlap) the nearest side counts. Never verified:
only the least bad.
"""

from __future__ import annotations

import math
from itertools import product

import numpy as np
from numpy.typing import NDArray

from brakeline.messaging.obstacle import Shapes
from brakeline.messaging.robot import Robot

Array = NDArray[np.float64]

SLOW = 0.3  # of the range of inputs that move the robot
BETTER = 1e-4  # m: less is no way out
COMPARED = 4  # violations, the worst first


def slow_inputs(robot: Robot) -> Array:
    """(C, m): every combination of little back, nothing and little ahead that the bounds allow."""
    share = np.where(robot.translates, SLOW, 1.0)
    levels = [
        sorted({float(low), min(max(0.0, low), high), float(high)})
        for low, high in zip(share * robot.low(), share * robot.high(), strict=True)
    ]
    return np.array(list(product(*levels)))


def least_violating(violated: Array, standing: Array, ends: NDArray[np.bool_]) -> int | None:
    """The candidate that gets out best, None if none does.

    violated (C, R): m, by which each candidate's tube is beyond each half-space; standing (R,): the same of standing;
    ends (R,): those at the plan's end.
    """
    now = np.sort(np.maximum(standing[ends], 0.0))[::-1][:COMPARED]
    worst = -np.sort(-np.maximum(violated[:, ends], 0.0), axis=1)[:, :COMPARED]
    best: int | None = None
    for c in np.flatnonzero(harmless(violated, standing)):
        than = now if best is None else worst[best]
        if lower(worst[c], than):
            best = int(c)
    return best


def harmless(violated: Array, standing: Array) -> NDArray[np.bool_]:
    """(C,): of which candidates is no half-space violated (C, R) by more than standing (R,) violates it?"""
    return np.asarray((violated <= np.maximum(standing, 0.0) + 1e-9).all(axis=1))


def lower(one: Array, other: Array) -> bool:
    """Is one of two falling sequences below the other, the first difference deciding?"""
    for a, b in zip(one, other, strict=True):
        if abs(a - b) > BETTER:
            return bool(a < b)
    return False


def escape_direction(near: Shapes, start: Array) -> Array:
    """A direction (d,) that leads off the nearest of obstacles, out of the one that the start is deepest inside."""
    out = near.out_of(start)
    depth = np.einsum("nd,nd->n", out, out)
    if depth.any():
        return np.asarray(out[np.argmax(depth)])
    ways = near.towards(start)
    return np.asarray(-ways[np.argmin(np.einsum("nd,nd->n", ways, ways))])


def turn_towards(robot: Robot, heading: float, away: Array) -> Array:
    """The input (m,) that turns on the spot towards a direction (d,) in the world."""
    error = math.remainder(math.atan2(away[1], away[0]) - heading, math.tau)
    wanted = np.where(robot.translates, 0.0, error / robot.period)
    return np.clip(wanted, robot.low(), robot.high())

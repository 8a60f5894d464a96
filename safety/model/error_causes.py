"""Group the held-out plans that left their predicted sets, by coordinate and by driving regime."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from brakeline.messaging.labels import split_label
from brakeline.messaging.robot import Array, Robot

PATH, AFTER = "the path within a period", "the stopping distance"
STANDING, SLOW, TURNING, FAST, BOTH = "standing", "slow", "turning", "fast", "fast and turning"
REGIMES = (STANDING, SLOW, TURNING, FAST, BOTH)
STILL = 0.05  # share of the inputs' bounds; a robot stands if every speed and input is below it
HALF = 0.5  # share of the inputs' bounds; from there on the robot drives fast, or turns


@dataclass(frozen=True)
class ViolationGroup:
    """Held-out plans of one regime that left their sets by the same part.

    Attributes:
        part: a coordinate's name, `PATH` or `AFTER`.
        regime: one of `REGIMES`.
        plans: number of these plans.
        of: number of all held-out plans of the regime.
        excess: the largest ratio of an error to its bound; above 1 the error is outside its set.
    """

    part: str
    regime: str
    plans: int
    of: int
    excess: float


def position_parts(robot: Robot) -> list[str]:
    """Return the names of the position's coordinates, in the frame of the tube's start."""
    if robot.heading is not None:
        return ["position ahead", "position aside"]
    return state_parts(robot)[: robot.position_dim]


def state_parts(robot: Robot, discs: int = 0) -> list[str]:
    """Return the names of the predicted coordinates.

    Args:
        robot: the robot.
        discs: number of further coordinates, which are displacements of the body's other discs.
    """
    names = [split_label(label)[0] for label in robot.state]
    if robot.heading is not None:
        names[: robot.position_dim] = position_parts(robot)
    return names + ["position of a disc of the body"] * discs


def regimes(robot: Robot, z: Array) -> NDArray[np.str_]:
    """Classify how the robot drove at the start of each plan.

    The regime depends on the largest of the input in force, the first input of the plan and the coordinates that follow
    them, as shares of the inputs' bounds.

    Args:
        robot: the robot.
        z (T, nz): regressors of the plans.

    Returns:
        Regimes (T,), each one of `REGIMES`.
    """
    m, reg = robot.action_dim, list(robot.regressor)
    before, chosen = z[:, len(reg) : len(reg) + m], z[:, len(reg) + m : len(reg) + 2 * m]
    strongest = np.maximum(np.abs(before), np.abs(chosen))
    for i, follower in enumerate(robot.follows):
        if follower in reg:
            strongest[:, i] = np.maximum(strongest[:, i], np.abs(z[:, reg.index(follower)]))
    shares = strongest / np.maximum(np.maximum(np.abs(robot.low()), np.abs(robot.high())), 1e-12)
    moves = np.asarray(robot.translates)
    driven, turned = (shares[:, which].max(1, initial=0.0) for which in (moves, ~moves))
    still = np.maximum(driven, turned) < STILL
    return np.select(
        [still, (driven >= HALF) & (turned >= HALF), driven >= HALF, turned >= HALF],
        [STANDING, BOTH, FAST, TURNING],
        SLOW,
    )


def group_violations(excess: Array, parts: list[str], driving: NDArray[np.str_]) -> tuple[ViolationGroup, ...]:
    """Group the plans that left their sets by part and regime, the largest group first.

    Args:
        excess (T,): the largest ratio of an error to its bound in each plan; above 1 or NaN, the plan left its set.
        parts: the part of each plan with that ratio (T).
        driving (T,): the regime of each plan.
    """
    left = ~(excess <= 1.0)
    every = Counter(driving.tolist())
    groups: dict[tuple[str, str], list[float]] = {}
    for row in np.flatnonzero(left):
        groups.setdefault((parts[row], str(driving[row])), []).append(float(excess[row]))
    violations = [
        ViolationGroup(part, regime, len(shares), every[regime], max(shares))
        for (part, regime), shares in groups.items()
    ]
    return tuple(sorted(violations, key=lambda one: (-one.plans, -one.excess)))

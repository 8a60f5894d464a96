"""Where held-out plans left their sets: by which coordinate, and how the robot drove then."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from brakeline.messaging.robot import Robot

Array = NDArray[np.float64]

PATH, AFTER = "the path within a period", "the way after the stop"
STANDING, SLOW, TURNING, FAST, BOTH = "standing", "slow", "turning", "fast", "fast and turning"
REGIMES = (STANDING, SLOW, TURNING, FAST, BOTH)
STILL = 0.05  # of its bounds: a robot stands if every speed and input is below
HALF = 0.5  # of its bounds: from there on it drives fast, or turns


@dataclass(frozen=True)
class ViolationGroup:
    """Held-out plans of one regime that left their sets by the same part. of: the held-out plans of that regime."""

    part: str
    regime: str
    plans: int
    of: int
    excess: float  # the largest share of its set that one of them came to


def position_parts(robot: Robot) -> list[str]:
    """Names of the position's coordinates, as a tube is seen: in the frame of its start."""
    if robot.heading is not None:
        return ["position ahead", "position aside"]
    return state_parts(robot)[: robot.position_dim]


def state_parts(robot: Robot, discs: int = 0) -> list[str]:
    """Names of the predicted coordinates; `discs`: so many are displacements of the body's further discs."""
    names = [label.rpartition(" [")[0] for label in robot.state]
    if robot.heading is not None:
        names[: robot.position_dim] = position_parts(robot)
    return names + ["position of a disc of the body"] * discs


def regimes(robot: Robot, z: Array) -> NDArray[np.str_]:
    """How the robot drove in plans with regressors z (T, nz): the strongest of the input in force, the first chosen
    one and the coordinates that follow them, as shares of the inputs' bounds.
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
    """The plans whose excess (T,) is above 1, by part and regime; the most plans first."""
    left = ~(excess <= 1.0)
    every = Counter(driving.tolist())
    groups: dict[tuple[str, str], list[float]] = {}
    for row in np.flatnonzero(left):
        groups.setdefault((parts[row], str(driving[row])), []).append(float(excess[row]))
    found = [
        ViolationGroup(part, regime, len(shares), every[regime], max(shares))
        for (part, regime), shares in groups.items()
    ]
    return tuple(sorted(found, key=lambda one: (-one.plans, -one.excess)))

"""Ranges of rays to the obstacles of many arenas, as a compiled loop; MuJoCo's rays are the twin in the tests."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from brakeline.compilation import compiled

Array = NDArray[np.float64]
Index = NDArray[np.int64]

# Of one obstacle, as of `Shapes`: axes, half, rho, round; then the ray: its start from the center, direction and length
SHAPE_AND_RAY = "f8[:,::1], f8[::1], f8, f8[::1], f8[::1], f8[::1], f8"
ARENAS = "f8[:,:,::1], f8[:,:,:,::1], f8[:,:,::1], f8[:,::1], f8[:,:,::1]"  # `Shapes.parts` of many arenas


@compiled(f"f8({SHAPE_AND_RAY})")
def _distance(axes: Array, half: Array, rho: float, rounded: Array, away: Array, beam: Array, far: float) -> float:
    """Return the distance along a unit beam to one obstacle, or infinity if the beam misses it or is too short.

    The obstacle is what is common to a slab along each flat axis and a ball across its rounded axes. From inside it,
    the beam ends where it leaves.
    """
    enters, leaves = -math.inf, math.inf
    square, along, beside = 0.0, 0.0, -rho * rho  # of the beam's part in the rounded axes
    for i in range(len(away)):
        place, way = 0.0, 0.0
        for j in range(len(away)):
            place += away[j] * axes[j, i]
            way += beam[j] * axes[j, i]
        if rho > 0.0 and rounded[i] > 0.0:
            square, along, beside = square + way * way, along + place * way, beside + place * place
        elif way != 0.0:
            a, b = (-half[i] - place) / way, (half[i] - place) / way
            enters, leaves = max(enters, min(a, b)), min(leaves, max(a, b))
            if leaves < 0.0 or enters > far:
                return math.inf
        elif abs(place) > half[i]:
            return math.inf
    under = along * along - square * beside
    if under < 0.0 or (square == 0.0 and beside > 0.0):
        return math.inf
    if square > 0.0:
        root = math.sqrt(under)
        enters, leaves = max(enters, (-along - root) / square), min(leaves, (-along + root) / square)
    if enters > leaves or leaves < 0.0:
        return math.inf
    return enters if enters >= 0.0 else leaves


@compiled(f"void({ARENAS}, i8[::1], i8[::1], f8[:,::1], f8[:,:,::1], f8[:,::1])")
def cast(
    center: Array, axes: Array, half: Array, rho: Array, rounded: Array, count: Index,
    rows: Index, origins: Array, beams: Array, ranges: Array,
) -> None:  # fmt: skip
    """Lower `ranges` (R, K) [m] to the first obstacle on the unit beams (R, K, d) from `origins` (R, d).

    Args:
        rows (R,): whose obstacles; row r has the first `count[r]` of its slots in use.
    """
    d = center.shape[2]
    for n in range(len(rows)):
        row = rows[n]
        for slot in range(count[row]):
            away, its_half = origins[n] - center[row, slot], half[row, slot]
            its_axes, its_rho, its_rounded = axes[row, slot], rho[row, slot], rounded[row, slot]
            square, reach = 0.0, its_rho
            for i in range(d):
                square += away[i] * away[i]
                reach = math.hypot(reach, its_half[i])
            outside = square - reach * reach  # of the ball around the obstacle, if positive
            for k in range(beams.shape[1]):
                towards = 0.0
                for i in range(d):
                    towards -= away[i] * beams[n, k, i]
                if outside > 0.0 and (towards < 0.0 or towards * towards < outside or towards - reach > ranges[n, k]):
                    continue  # the beam misses the ball, or ends before it
                distance = _distance(its_axes, its_half, its_rho, its_rounded, away, beams[n, k], ranges[n, k])
                ranges[n, k] = min(ranges[n, k], distance)

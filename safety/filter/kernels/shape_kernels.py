"""Compiled loops over obstacles and the planes beside them (docs/method.md §3).

center (n, d), axes (n, d, d), half (n, d), rho (n,), rounded (n, d) and margin (n,) are those of `Shapes`.

`tests/safety/kernel_twins.py` has each function in plain NumPy.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from brakeline.compilation import compiled
from brakeline.messaging.obstacle import LARGEST, ORTHONORMAL
from brakeline.safety.filter.halfspaces import TOUCHING

Array = NDArray[np.float64]
Index = NDArray[np.int64]


@compiled("f8(f8[::1], f8[:,::1], f8[::1], f8, f8[::1], f8[::1], f8[::1], f8[::1])")
def _towards(
    center: Array, axes: Array, half: Array, rho: float, rounded: Array, point: Array, rest: Array, way: Array
) -> float:
    """Write the vector from a point (d,) to the closest point of one obstacle into `way`; return its length.

    rest (d,) is overwritten: the vector from the middle part of the obstacle to the point, in the obstacle's axes.
    """
    d, square = len(point), 0.0
    for i in range(d):
        local = 0.0
        for j in range(d):
            local += (point[j] - center[j]) * axes[j, i]
        inside = -half[i] if local < -half[i] else (half[i] if local > half[i] else local)
        rest[i] = local - inside
        square += (rest[i] * rounded[i]) ** 2
    norm, least = math.sqrt(square), max(rho, 1e-300)
    share = rho / (least if norm < least else norm)  # NaN for NaN
    for i in range(d):
        rest[i] -= rest[i] * rounded[i] * share
    square = 0.0
    for j in range(d):
        way[j] = 0.0
        for i in range(d):
            way[j] -= rest[i] * axes[j, i]
        square += way[j] * way[j]
    return math.sqrt(square)


@compiled("f8[::1](f8[:,::1], f8[:,:,::1], f8[:,::1], f8[::1], f8[:,::1], f8[::1])")
def distances(center: Array, axes: Array, half: Array, rho: Array, rounded: Array, point: Array) -> Array:
    """Return the distances (n,) from a point (d,) to each obstacle [m]; 0 inside."""
    away, rest, way = np.empty(len(rho)), np.empty_like(point), np.empty_like(point)
    for i in range(len(rho)):
        away[i] = _towards(center[i], axes[i], half[i], rho[i], rounded[i], point, rest, way)
    return away


@compiled("b1(f8[:,::1], f8[:,:,::1], f8[:,::1], f8[::1], f8[:,::1], f8[::1])")
def plausible(center: Array, axes: Array, half: Array, rho: Array, rounded: Array, margin: Array) -> bool:
    """Return whether all numbers may be those of obstacles. NaN may: an obstacle with NaN counts as everywhere.

    Sizes are not negative, `axes` are orthonormal, and no number is larger than a wall needs.
    """
    wrong = False
    for n in range(len(rho)):
        wrong |= abs(margin[n]) > LARGEST or rho[n] < 0.0 or rho[n] > LARGEST
        for i in range(center.shape[1]):
            wrong |= abs(center[n, i]) > LARGEST or half[n, i] < 0.0 or half[n, i] > LARGEST
            wrong |= rounded[n, i] != 0.0 and abs(rounded[n, i] - 1.0) > 0.0  # not of NaN
            for k in range(i + 1):
                product = -1.0 if i == k else 0.0
                for j in range(center.shape[1]):
                    product += axes[n, j, i] * axes[n, j, k]
                wrong |= abs(product) > ORTHONORMAL
    return not wrong


@compiled("Tuple((f8, b1[::1], i8))(f8[::1], f8, f8)")
def parted(away: Array, beyond: float, reach: float) -> tuple[float, NDArray[np.bool_], int]:
    """Return the distance [m] of the nearest obstacle beyond reach, at most `beyond`, and which (n,) are within.

    An obstacle whose distance is NaN counts as within reach. The last value is the number of obstacles within.
    """
    counts, number = np.empty(len(away), np.bool_), 0
    for i in range(len(away)):
        counts[i] = not away[i] > reach
        number += counts[i]
        if not counts[i]:
            beyond = min(beyond, away[i])
    return beyond, counts, number


@compiled("i8[:,::1](f8[:,:,::1], f8[:,::1], f8[:,::1])")
def roomiest_planes(unit: Array, level: Array, ends: Array) -> Index:
    """Return the index (n, N) of the plane, among the 2N+1, that each period uses.

    unit (n, 2N+1, d), level (n, 2N+1): the planes. ends (N+1, d): nominal positions at the ends of the periods.
    From the first period in which no plane separates both ends from the obstacle, the plan crosses the obstacle. The
    plane before then stays in force: a plane from beyond the obstacle would hold on the wrong side.
    """
    n, N, d = len(unit), len(ends) - 1, ends.shape[1]
    choice = np.empty((n, N), np.int64)
    for i in range(n):
        through = False
        for k in range(N):
            best, most, numbers = 2 * k, -np.inf, True
            for q in range(2 * k, 2 * k + 3):
                first, last = 0.0, 0.0
                for axis in range(d):
                    first += unit[i, q, axis] * ends[k, axis]
                    last += unit[i, q, axis] * ends[k + 1, axis]
                room = level[i, q] - max(first, last)
                numbers &= first == first and last == last and room == room
                if room > most:
                    best, most = q, room
            through |= not (numbers and most > 0.0)
            if through:
                best = choice[i, k - 1] if k > 0 else 0
            choice[i, k] = best
    return choice


@compiled(
    "Tuple((f8[:,:,::1], f8[:,::1]))"
    "(f8[:,::1], f8[:,:,::1], f8[:,::1], f8[::1], f8[:,::1], f8[::1], f8[::1], f8[:,::1], f8, f8[::1])"
)
def planes_beside(
    center: Array,
    axes: Array,
    half: Array,
    rho: Array,
    rounded: Array,
    margin: Array,
    start: Array,
    nominal: Array,
    keep_off: float,
    measured: Array,
) -> tuple[Array, Array]:
    """Return normals (n, N, d) and offsets (n, N) of the half-spaces beside obstacles: see `half_spaces`."""
    n, (N, d) = len(rho), nominal.shape
    ends, seen_from, rest = np.zeros((N + 1, d)), np.empty(d), np.empty(d)
    for k in range(N):
        ends[k + 1] = nominal[k] - start
    unit, level = np.empty((n, 2 * N + 1, d)), np.empty((n, 2 * N + 1))
    for i in range(n):
        touching = False
        for q in range(2 * N + 1):
            for axis in range(d):  # at an end of a period, or in the middle
                seen_from[axis] = 0.5 * (ends[q // 2, axis] + ends[(q + 1) // 2, axis])
            gap = _towards(center[i], axes[i], half[i], rho[i], rounded[i], start + seen_from, rest, unit[i, q])
            if not gap > TOUCHING:  # true for NaN, too
                touching |= q == 0
                level[i, q], gap = -np.inf, max(gap, TOUCHING) if gap == gap else gap
            else:
                level[i, q] = 0.0
                for axis in range(d):
                    level[i, q] += unit[i, q, axis] / gap * (unit[i, q, axis] + seen_from[axis])
            for axis in range(d):
                unit[i, q, axis] /= gap
        if touching:
            level[i] = -np.inf
    choice = roomiest_planes(unit, level, ends)
    normals, offsets = np.empty((n, N, d)), np.empty((n, N))
    for i in range(n):
        for k in range(N):
            q, distance = choice[i, k], keep_off + margin[i]
            normals[i, k], offsets[i, k] = unit[i, q], level[i, q] - (0.0 if distance < 0.0 else distance)
            for axis in range(d):
                offsets[i, k] -= abs(unit[i, q, axis]) * measured[axis]
    return normals, offsets

"""Distances to obstacles, free paths and gaps between outlines, as compiled loops; NumPy's twins are in the tests.

Obstacles are the arrays of `Shapes.parts`: center, axes, half, rho, round.
"""

from __future__ import annotations

import math
from heapq import heappop, heappush

import numpy as np
from numpy.typing import NDArray

from brakeline.compilation import compiled
from brakeline.sim.kernels.ray_kernels import ARENAS

Array = NDArray[np.float64]
Index = NDArray[np.int64]

SHAPES = "f8[:,::1], f8[:,:,::1], f8[:,::1], f8[::1], f8[:,::1]"
OUTLINES = "f8[:,::1], f8[:,:,::1], f8[:,::1], f8[::1]"  # obstacles in the plane: center, axes, half, rho


@compiled(f"f8({SHAPES}, f8[::1])")
def nearest_distance(center: Array, axes: Array, half: Array, rho: Array, rounded: Array, point: Array) -> float:
    """Return the distance [m] from a point (d,) to the nearest obstacle; 0 inside one, inf without any, NaN for NaN."""
    nearest, d = math.inf, len(point)
    if np.isnan(point).any():
        return math.nan  # no comparison holds for NaN, so each obstacle would count as far away
    for n in range(len(rho)):
        across, along = 0.0, 0.0  # squared, beyond the box: in the rounded axes, and in the others
        for i in range(d):
            place = 0.0
            for j in range(d):
                place += (point[j] - center[n, j]) * axes[n, j, i]
            beyond = max(abs(place) - half[n, i], 0.0)
            if rounded[n, i] > 0.0:
                across += beyond * beyond
            else:
                along += beyond * beyond
        # The root takes the most time. It is only computed where this obstacle may be nearer than those before.
        if across + along < (nearest + rho[n]) ** 2:
            beside = max(math.sqrt(across) - rho[n], 0.0)
            nearest = min(nearest, math.sqrt(beside * beside + along))
    return nearest


@compiled(f"f8[::1]({SHAPES}, f8[:,::1])")
def nearest_distances(center: Array, axes: Array, half: Array, rho: Array, rounded: Array, points: Array) -> Array:
    """Return the distance (P,) [m] from each point (P, d) to the nearest obstacle; 0 inside one."""
    distances = np.empty(len(points))
    for k in range(len(points)):
        distances[k] = nearest_distance(center, axes, half, rho, rounded, points[k])
    return distances


@compiled(f"f8[:,::1]({ARENAS}, i8[::1], i8[::1], f8[:,:,::1])")
def distances_in_arenas(
    center: Array, axes: Array, half: Array, rho: Array, rounded: Array, count: Index, rows: Index, points: Array
) -> Array:
    """Return the distance (R, P) [m] from points (R, P, d) to the nearest obstacle of each row's arena.

    A row's arena has `count` obstacles; the places after them are not in use.
    """
    distances = np.empty(points.shape[:2])
    for r in range(len(rows)):
        row, n = rows[r], count[rows[r]]
        parts = center[row, :n], axes[row, :n], half[row, :n], rho[row, :n], rounded[row, :n]
        for p in range(points.shape[1]):
            distances[r, p] = nearest_distance(*parts, points[r, p])
    return distances


@compiled(f"b1({SHAPES}, f8[::1], f8, i8[::1], i8[:,::1], i8[::1], i8[::1], f8)")
def connected(
    center: Array, axes: Array, half: Array, rho: Array, rounded: Array,
    low: Array, cell: float, size: Index, steps: Index, first: Index, last: Index, clearance: float,
) -> bool:  # fmt: skip
    """Return whether cells whose centres keep a clearance [m] lead from one cell to another.

    The search takes the open cell that is nearest to the last one, so it measures few cells where the way is free.

    Args:
        low (d,), cell: m, the corner of the grid and the edge of a cell.
        size (d,): number of cells along each axis.
        steps (s, d): from a cell to its neighbours.
        first, last (d,): indices of the cells.
        clearance: m.
    """
    seen = np.zeros(np.prod(size), np.bool_)
    cells, number = np.empty((len(seen), len(size)), np.int64), 0
    queue = [(math.inf, 0)]  # squared distance to the last cell, place in `cells`
    queue.clear()  # Numba takes the type of the list from the entry above
    here, neighbours = first, np.zeros((1, len(size)), np.int64)  # at first, only the cell itself
    while True:
        for s in range(len(neighbours)):
            index = here + neighbours[s]
            if (index < 0).any() or (index >= size).any():
                continue
            flat = 0
            for i in range(len(size)):
                flat = flat * size[i] + index[i]
            if seen[flat]:
                continue
            seen[flat] = True
            centre = low + cell * (index + 0.5)
            if nearest_distance(center, axes, half, rho, rounded, centre) >= clearance:
                cells[number] = index
                heappush(queue, (float(((index - last) ** 2).sum()), number))
                number += 1
        if not len(queue):
            return False
        away, place = heappop(queue)
        if away == 0.0:
            return True
        here, neighbours = cells[place], steps


@compiled("f8(f8[::1], f8[:,::1], f8[::1], f8[::1], f8[:,::1], f8[::1])")
def _corner_distance(center: Array, axes: Array, half: Array, other: Array, its_axes: Array, its_half: Array) -> float:
    """Return the least distance [m] from a rectangle's corners and centre to another rectangle; 0 inside."""
    least = math.inf
    for a, b in ((1.0, 1.0), (1.0, -1.0), (-1.0, 1.0), (-1.0, -1.0), (0.0, 0.0)):
        along, across = a * half[0], b * half[1]
        x = center[0] + axes[0, 0] * along + axes[0, 1] * across - other[0]
        y = center[1] + axes[1, 0] * along + axes[1, 1] * across - other[1]
        beyond = max(abs(x * its_axes[0, 0] + y * its_axes[1, 0]) - its_half[0], 0.0)
        beside = max(abs(x * its_axes[0, 1] + y * its_axes[1, 1]) - its_half[1], 0.0)
        least = min(least, beyond * beyond + beside * beside)
    return math.sqrt(least)


@compiled(f"i8({OUTLINES}, {OUTLINES}, f8)")
def first_fitting(
    center: Array, axes: Array, half: Array, rho: Array,
    placed: Array, their_axes: Array, their_half: Array, their_rho: Array, gap: float,
) -> int:  # fmt: skip
    """Return the first outline that keeps a gap [m] to each one that is placed already, or -1.

    An outline is a rectangle (of a disc: its centre) that is grown by rho. Two disjoint convex polygons are closest at
    a corner of one of them, so the corners of each are measured.
    """
    for k in range(len(rho)):
        fits = True
        for n in range(len(their_rho)):
            one = _corner_distance(center[k], axes[k], half[k], placed[n], their_axes[n], their_half[n])
            two = _corner_distance(placed[n], their_axes[n], their_half[n], center[k], axes[k], half[k])
            if min(one, two) - rho[k] - their_rho[n] < gap:
                fits = False
                break
        if fits:
            return k
    return -1

"""What `patches.py` makes of all beams of an image, compiled: in single precision, a pass over all at a time."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from brakeline.safety.compilation import compiled

Array = NDArray[np.float64]
Single = NDArray[np.float32]

SINGLE = 1e-6  # of a range: more than a few operations in single precision are off by


@compiled("void(f4[::1], f4[::1], f4[::1])")
def _lesser(one: Single, other: Single, found: Single) -> None:
    """Of each two numbers. (So written it becomes one instruction for many of them, and `min` does not.)"""
    for j in range(len(found)):
        a, b = one[j], other[j]
        found[j] = a if a < b else b


@compiled("void(f4[::1], f4[::1])")
def _copy(values: Single, found: Single) -> None:
    """Each number. (`found[:] = values` looks whether they overlap, and takes one at a time.)"""
    for j in range(len(found)):
        found[j] = values[j]


@compiled("void(f4[:,::1], f4, f4)")
def scale_to(values: Single, share: float, most: float) -> None:
    """Each becomes so much of what it was, and that at the most."""
    flat = values.ravel()
    for k in range(len(flat)):
        value = flat[k] * share
        flat[k] = value if value < most else most


@compiled("void(f4[::1], f4[::1], f4[::1], i8, i8)")
def least_ahead(values: Single, spare: Single, found: Single, count: int, stride: int) -> None:
    """Of each number and those after it, so many in all, so far apart each; overwrites values and spare."""
    n, width = len(values), 1  # so many each entry is the least of
    while 2 * width <= count:
        n -= width * stride
        _lesser(values[:n], values[width * stride : width * stride + n], spare[:n])
        values, spare = spare, values
        width *= 2
    ahead = (count - width) * stride
    _lesser(values[: len(found)], values[ahead : ahead + len(found)], found)


@compiled("void(f4[:,::1], i8)")
def _least_beside(rings: Single, beside: int) -> None:
    """Of each number in rings (R, A) makes the least of so many columns beside it, on either side. All at once: what
    comes of windows from one ring into the next is not looked at."""
    columns, count = rings.shape[1], 2 * beside + 1
    if count >= columns:
        for i in range(len(rings)):
            rings[i] = rings[i].min()
        return
    each = columns + count - 1
    wrapped, spare = np.empty((len(rings), each), np.float32), np.empty(len(rings) * each, np.float32)
    for i in range(len(rings)):
        ring, round_ = rings[i], wrapped[i]
        _copy(ring[columns - beside :], round_[:beside])
        _copy(ring, round_[beside : beside + columns])
        _copy(ring[:beside], round_[beside + columns :])
    least = np.empty((len(rings), each), np.float32)
    least_ahead(wrapped.ravel(), spare, least.ravel()[: len(rings) * each - count + 1], count, 1)
    for i in range(len(rings)):
        _copy(least[i, :columns], rings[i])


@compiled("f4[:,::1](f4[:,::1], i8, i8[::1])")
def least_of(values: Single, rows: int, beside: NDArray[np.int64]) -> Single:
    """Of a grid (E, A), round in its columns: the least (E, A) of so many rows above and below each, and so many
    columns (E,) beside it."""
    rings, columns = values.shape
    size, edge = rings * columns, rows * columns
    tall, spare = np.empty(size + 2 * edge, np.float32), np.empty(size + 2 * edge, np.float32)
    tall[:edge] = tall[edge + size :] = np.float32(np.inf)
    _copy(values.ravel(), tall[edge : edge + size])
    found = np.empty((rings, columns), np.float32)
    least_ahead(tall, spare, found.ravel(), 2 * rows + 1, columns)
    first = 0
    for i in range(1, rings + 1):
        if i == rings or beside[i] != beside[first]:
            _least_beside(found[first:i], beside[first])
            first = i
    return found


@compiled("f4[:,::1](f8[:,::1], i8, i8, f8, f8)")
def heard(ranges: Array, below: int, above: int, far: float, error: float) -> Single:
    """The returns at the least (below + E + above, A) of a grid's ranges [m], so many rings added; < 0: not known."""
    rings, columns = ranges.shape
    found = np.full((below + rings + above, columns), -1.0, np.float32)
    for i in range(rings):
        ring, out = ranges[i], found[below + i]
        for j in range(columns):
            range_ = ring[j]
            least = (range_ if range_ < far else far) - error
            least = least if least > 0.0 else 0.0
            out[j] = least if range_ > 0.0 else -1.0
    return found


@compiled("f4[:,::1](f4[:,::1])")
def farthest_of_meshes(returns: Single) -> Single:
    """Of each beam and its neighbours to the left, above and above to the left (E, A); of the last ring, of two. 0:
    none is known."""
    rings, columns = returns.shape
    found, tall = np.empty((rings, columns), np.float32), np.empty(columns + 1, np.float32)
    beside, zero = tall[1:], np.float32(0.0)
    for i in range(rings):
        ring, above, out = returns[i], returns[min(i + 1, rings - 1)], found[i]
        for j in range(columns):
            tall[j] = ring[j] if ring[j] > above[j] else above[j]
        tall[columns] = tall[0]
        for j in range(columns):
            most = tall[j] if tall[j] > beside[j] else beside[j]
            out[j] = most if most > zero else zero
    return found


@compiled("b1(f4[:,::1], i8, i8, f4, i8, i8)")
def _farther(meshes: Single, ring: int, column: int, than: float, rows: int, beside: int) -> bool:
    """Do all meshes about a beam return from farther?"""
    rings, columns = meshes.shape
    aside = min(beside, columns // 2)
    for i in range(max(ring - rows, 0), min(ring + rows, rings - 1) + 1):
        for j in range(column - aside, column + aside + 1):
            if meshes[i, j % columns] <= than:
                return False
    return True


@compiled("i8(f4[:,::1], f4[:,::1], f4, f4, i8, i8[::1])")
def forget_ghosts(
    returns: Single, meshes: Single, share: float, error: float, rows: int, beside: NDArray[np.int64]
) -> int:
    """Make unknown what returns from nearer than so much of the least of all meshes about it, less an error [m]. So
    many are left that are known."""
    rings, columns = returns.shape
    left, pair, spare = returns.size, np.empty(columns + 1, np.float32), np.empty(columns, np.float32)
    signs, zero = spare.view(np.int32), np.float32(0.0)
    for i in range(rings):
        ring, own, under, any_ = returns[i], meshes[i], meshes[max(i - min(rows, 1), 0)], np.int32(0)
        for j in range(columns):
            pair[j + 1] = own[j] if own[j] < under[j] else under[j]
        aside = min(beside[i], 1)
        pair[0] = pair[columns]
        before = pair[1 - aside : 1 - aside + columns]
        for j in range(columns):  # one of the four that it is in returns from no farther: so do not all
            one, other = pair[j + 1], before[j]
            least = share * ((one if one < other else other) - error)
            spare[j] = ring[j] - (least if least > zero else zero)
        for j in range(columns):
            any_ |= signs[j]
        if any_ >= 0:  # all are known, and none is doubtful
            continue
        for j in range(columns):
            if ring[j] < zero:
                left -= 1
            elif spare[j] < zero:
                than = (ring[j] / share + error) * (1.0 + SINGLE)
                if _farther(meshes, i, j, than, rows, beside[i]):
                    ring[j] = -1.0
                    left -= 1
    return left


@compiled("Tuple((f4[:,::1], f4[:,::1]))(f8[:,::1], i8, i8, f8, f8, f4, i8, i8[::1], i8, i8[::1], f4, f4, b1)")
def free_of_single(
    ranges: Array,
    below: int,
    above: int,
    far: float,
    error: float,
    mesh_share: float,
    mesh_rows: int,
    mesh_beside: NDArray[np.int64],
    rows: int,
    beside: NDArray[np.int64],
    share: float,
    most: float,
    doubt: bool,
) -> tuple[Single, Single]:
    """The returns, without ghosts, and how far each patch is free by single beams; of no size where not all of them are
    known, or they are doubted. Told are the windows of balls that cover a mesh, and of single beams."""
    returns = heard(ranges, below, above, far, error)
    meshed = farthest_of_meshes(returns)
    left = forget_ghosts(returns, meshed, mesh_share, 2.0 * error, mesh_rows, mesh_beside)
    if left < returns.size or doubt:
        return returns, np.empty((0, 0), np.float32)
    free = least_of(returns, rows, beside)
    scale_to(free, share, most)
    return returns, free

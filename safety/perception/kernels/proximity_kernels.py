"""Compiled passes over all beams of a range image, in single precision (`image_coverage.py`).

A grid (E, A) has E rings of equal elevation and A columns of equal azimuth. Its columns wrap around. A *mesh* is the
cell between four neighbouring beams.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from brakeline.compilation import compiled
from brakeline.safety.perception.image_coverage import SINGLE

Array = NDArray[np.float64]
Single = NDArray[np.float32]

UNKNOWN = -1.0  # in place of a return: the beam measured nothing


@compiled("void(f4[::1], f4[::1], f4[::1])")
def _minimum(one: Single, other: Single, out: Single) -> None:
    """Write the smaller number of each pair. LLVM vectorises this loop, and not one with `min`."""
    for j in range(len(out)):
        a, b = one[j], other[j]
        out[j] = a if a < b else b


@compiled("void(f4[::1], f4[::1])")
def _copy(values: Single, out: Single) -> None:
    """Copy the numbers. `out[:] = values` would test for overlap and copy one number at a time."""
    for j in range(len(out)):
        out[j] = values[j]


@compiled("void(f4[:,::1], f4, f4)")
def scale_to(values: Single, share: float, most: float) -> None:
    """Replace each value by `min(share * value, most)`."""
    flat = values.ravel()
    for k in range(len(flat)):
        value = flat[k] * share
        flat[k] = value if value < most else most


@compiled("void(f4[::1], f4[::1], f4[::1], i8, i8)")
def minimum_ahead(values: Single, spare: Single, out: Single, count: int, stride: int) -> None:
    """Write the minimum of each number and those after it: `count` numbers, `stride` apart.

    The window doubles in each pass. The function overwrites values and spare.
    """
    n, width = len(values), 1  # each entry is the minimum of `width` numbers
    while 2 * width <= count:
        n -= width * stride
        _minimum(values[:n], values[width * stride : width * stride + n], spare[:n])
        values, spare = spare, values
        width *= 2
    ahead = (count - width) * stride
    _minimum(values[: len(out)], values[ahead : ahead + len(out)], out)


@compiled("void(f4[:,::1], i8)")
def _minimum_beside(rings: Single, beside: int) -> None:
    """Replace each number in rings (R, A) by the minimum of itself and `beside` columns on either side.

    The rings are one long row to `minimum_ahead`. Nothing reads the windows that reach from one ring into the next.
    """
    columns, count = rings.shape[1], 2 * beside + 1
    if count >= columns:
        for i in range(len(rings)):
            rings[i] = rings[i].min()
        return
    padded = columns + count - 1
    wrapped, spare = np.empty((len(rings), padded), np.float32), np.empty(len(rings) * padded, np.float32)
    for i in range(len(rings)):
        ring, row = rings[i], wrapped[i]
        _copy(ring[columns - beside :], row[:beside])
        _copy(ring, row[beside : beside + columns])
        _copy(ring[:beside], row[beside + columns :])
    least = np.empty((len(rings), padded), np.float32)
    minimum_ahead(wrapped.ravel(), spare, least.ravel()[: len(rings) * padded - count + 1], count, 1)
    for i in range(len(rings)):
        _copy(least[i, :columns], rings[i])


@compiled("f4[:,::1](f4[:,::1], i8, i8[::1])")
def window_minimum(values: Single, rows: int, beside: NDArray[np.int64]) -> Single:
    """Return the minimum (E, A) of each beam's window.

    rows: rings above and below the beam; beside: (E,) columns to its left and to its right, by its ring.
    """
    rings, columns = values.shape
    size, edge = rings * columns, rows * columns
    tall, spare = np.empty(size + 2 * edge, np.float32), np.empty(size + 2 * edge, np.float32)
    tall[:edge] = tall[edge + size :] = np.float32(np.inf)
    _copy(values.ravel(), tall[edge : edge + size])
    least = np.empty((rings, columns), np.float32)
    minimum_ahead(tall, spare, least.ravel(), 2 * rows + 1, columns)
    first = 0
    for i in range(1, rings + 1):
        if i == rings or beside[i] != beside[first]:
            _minimum_beside(least[first:i], beside[first])
            first = i
    return least


@compiled("f4[:,::1](f8[:,::1], UniTuple(i8, 2), f8, f8)")
def shortest_returns(ranges: Array, added: tuple[int, int], far: float, error: float) -> Single:
    """Return the shortest distances [m] that the ranges [m] allow, or `UNKNOWN`; (below + E + above, A).

    added: the numbers of rings (below, above) that the sensor does not see.
    """
    below, above = added
    rings, columns = ranges.shape
    returns = np.full((below + rings + above, columns), UNKNOWN, np.float32)
    for i in range(rings):
        ring, out = ranges[i], returns[below + i]
        for j in range(columns):
            range_ = ring[j]
            least = (range_ if range_ < far else far) - error
            least = least if least > 0.0 else 0.0
            out[j] = least if range_ > 0.0 else UNKNOWN
    return returns


@compiled("f4[:,::1](f4[:,::1])")
def mesh_maximum(returns: Single) -> Single:
    """Return the longest return of each mesh (E, A): of a beam, its left neighbour, and the two above them.

    The last ring has no ring above it. 0: no return in the mesh is known.
    """
    rings, columns = returns.shape
    meshes, tall = np.empty((rings, columns), np.float32), np.empty(columns + 1, np.float32)
    beside, zero = tall[1:], np.float32(0.0)
    for i in range(rings):
        ring, above, out = returns[i], returns[min(i + 1, rings - 1)], meshes[i]
        for j in range(columns):
            tall[j] = ring[j] if ring[j] > above[j] else above[j]
        tall[columns] = tall[0]
        for j in range(columns):
            most = tall[j] if tall[j] > beside[j] else beside[j]
            out[j] = most if most > zero else zero
    return meshes


@compiled("b1(f4[:,::1], i8, i8, f4, i8, i8)")
def _all_farther(meshes: Single, ring: int, column: int, limit: float, rows: int, beside: int) -> bool:
    """Return whether all meshes in the window of a beam return from beyond the limit [m]."""
    rings, columns = meshes.shape
    reach = min(beside, columns // 2)
    for i in range(max(ring - rows, 0), min(ring + rows, rings - 1) + 1):
        for j in range(column - reach, column + reach + 1):
            if meshes[i, j % columns] <= limit:
                return False
    return True


@compiled("i8(f4[:,::1], f4[:,::1], f4, f4, i8, i8[::1])")
def forget_ghosts(
    returns: Single, meshes: Single, share: float, error: float, rows: int, beside: NDArray[np.int64]
) -> int:
    """Set each ghost in returns (E, A) to `UNKNOWN`, and return how many known returns are left.

    A ghost is a return below `share * (m - error)`, with m the minimum of meshes (E, A) in the beam's window (`rows`,
    `beside`). A cheap test with the four meshes around a beam rules most beams out.
    """
    rings, columns = returns.shape
    left, pair, excess = returns.size, np.empty(columns + 1, np.float32), np.empty(columns, np.float32)
    signs, zero = excess.view(np.int32), np.float32(0.0)
    for i in range(rings):
        ring, own, under, any_ = returns[i], meshes[i], meshes[max(i - min(rows, 1), 0)], np.int32(0)
        for j in range(columns):
            pair[j + 1] = own[j] if own[j] < under[j] else under[j]
        reach = min(beside[i], 1)
        pair[0] = pair[columns]
        before = pair[1 - reach : 1 - reach + columns]
        for j in range(columns):
            one, other = pair[j + 1], before[j]
            least = share * ((one if one < other else other) - error)
            excess[j] = ring[j] - (least if least > zero else zero)
        for j in range(columns):
            any_ |= signs[j]
        if any_ >= 0:  # no sign bit is set: the ring has no unknown return and no candidate for a ghost
            continue
        for j in range(columns):
            if ring[j] < zero:
                left -= 1
            elif excess[j] < zero:
                limit = (ring[j] / share + error) * (1.0 + SINGLE)
                if _all_farther(meshes, i, j, limit, rows, beside[i]):
                    ring[j] = UNKNOWN
                    left -= 1
    return left


@compiled(
    "Tuple((f4[:,::1], f4[:,::1]))"
    "(f8[:,::1], UniTuple(i8, 2), Tuple((f8, f8, i8)), Tuple((f8, i8, i8[::1])), Tuple((i8, i8[::1])), UniTuple(f8, 2))"
)
def single_beam_ranges(
    ranges: Array,
    added: tuple[int, int],
    sensor: tuple[float, float, int],
    mesh_window: tuple[float, int, NDArray[np.int64]],
    beam_window: tuple[int, NDArray[np.int64]],
    scale: tuple[float, float],
) -> tuple[Single, Single]:
    """Return the returns (E', A) without ghosts, and the free range F (E', A) [m] of each patch by single beams.

    F has no entries if a return is unknown or the sensor's beams are doubted: then single beams do not suffice.

    Args:
        ranges: (E, A) measured [m].
        added: the numbers of rings (below, above) that the sensor does not see.
        sensor: (largest range [m], range error [m], doubt).
        mesh_window: (share, rows, columns (E',)) of the ghost test (`forget_ghosts`).
        beam_window: (rows, columns (E',)) around a patch whose beams bound its free range.
        scale: (share, most [m]) of `scale_to`.
    """
    far, error, doubt = sensor
    mesh_share, mesh_rows, mesh_beside = mesh_window
    rows, beside = beam_window
    share, most = scale
    returns = shortest_returns(ranges, added, far, error)
    known = forget_ghosts(returns, mesh_maximum(returns), mesh_share, 2.0 * error, mesh_rows, mesh_beside)
    if known < returns.size or doubt:
        return returns, np.empty((0, 0), np.float32)
    free = window_minimum(returns, rows, beside)
    scale_to(free, share, most)
    return returns, free

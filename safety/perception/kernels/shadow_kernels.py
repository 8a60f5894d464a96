"""Compiled: the shadows that the patches of a range image cast into the boxes of a plan (`occluded_regions.py`).

A shadow is a *tapered capsule*: the hull of a ball around its near end and a ball around its far end. An array of n
capsules is (ROWS, n), contiguous, in single precision, relative to an origin. The constants below name its rows.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from brakeline.compilation import compiled
from brakeline.safety.filter.halfspaces import TOUCHING
from brakeline.safety.perception.kernels.proximity_kernels import minimum_ahead

Array = NDArray[np.float64]
Single = NDArray[np.float32]

# Rows of an array of capsules. `derive_rows` computes the last two from the others.
NEAR_X, NEAR_Y, NEAR_Z = 0, 1, 2  # m: near end
AXIS_X, AXIS_Y, AXIS_Z = 3, 4, 5  # unit vector from the near end to the far end
LENGTH = 6  # m: between the ends
NEAR_RADIUS, FAR_RADIUS = 7, 8  # m: of the balls
TAPER = 9  # growth of the radius per metre of length
EXTENT = 10  # m: sum of all magnitudes; NaN if any of them is NaN
ROWS = 11

BLOCK = 64  # rays that one test of signs covers
ROUNDING, ROUNDING_EXTENT = 1e-4, 100.0  # m: the error of single precision for coordinates up to this extent


@compiled("f8(f8)")
def rounding(extent: float) -> float:
    """Return the error [m] of positions in single precision, for coordinates up to `extent` [m]."""
    return ROUNDING * max(1.0, extent / ROUNDING_EXTENT)


@compiled("f4[::1](f4[:,::1], i8[::1], i8)")
def patch_minimum(free: Single, columns_per_patch: NDArray[np.int64], patches: int) -> Single:
    """Return the minimum (patches,) of the beams of each patch in a grid (E, A).

    columns_per_patch: (E,) neighbouring columns of a ring that form one patch; the last patch of a ring may have fewer.
    """
    rings, columns = free.shape
    nearest, first = np.empty(patches, np.float32), 0
    ahead, spare, least = np.empty(2 * columns, np.float32), np.empty(2 * columns, np.float32), free[0].copy()
    for i in range(rings):
        width, ring = min(columns_per_patch[i], columns), free[i]
        count = (columns + width - 1) // width
        out = nearest[first : first + count]
        if width == 1:
            for j in range(count):
                out[j] = ring[j]
        else:
            for j in range(columns):
                ahead[j] = ring[j]
            ahead[columns : columns + width] = np.float32(np.inf)
            minimum_ahead(ahead[: columns + width - 1], spare, least, width, 1)
            for j in range(count):
                out[j] = least[j * width]
        first += count
    return nearest


@compiled("void(f4[:,::1], f4[::1], f4[:,::1], f4[:,::1], f4, f4[::1])")
def _depth_in_box(
    directions: Single, near: Single, rotation: Single, faces: Single, last: np.float32, depth: Single
) -> None:
    """Write how deep [m] (n,) the near end of each ray lies in a box and before the range `last`; negative: outside.

    The sensor is the origin. directions: (3, n) in the sensor's frame; near: (n,) ranges of the near ends; rotation:
    (3, 3) from the sensor's frame to the world; faces: (3, 2) lowest and highest coordinates of the box.
    """
    x, y, z = directions[0], directions[1], directions[2]  # scalars and rows by name, so that LLVM vectorises the loop
    a, b, c = rotation[0, 0], rotation[0, 1], rotation[0, 2]
    d, e, f = rotation[1, 0], rotation[1, 1], rotation[1, 2]
    g, h, i = rotation[2, 0], rotation[2, 1], rotation[2, 2]
    west, east, south, north, low, high = faces[0, 0], faces[0, 1], faces[1, 0], faces[1, 1], faces[2, 0], faces[2, 1]
    for k in range(len(depth)):
        p, q, r, t = x[k], y[k], z[k], near[k]
        u, v, w, least = t * (a * p + b * q + c * r), t * (d * p + e * q + f * r), t * (g * p + h * q + i * r), last - t
        least = least if least < u - west else u - west
        least = least if least < east - u else east - u
        least = least if least < v - south else v - south
        least = least if least < north - v else north - v
        least = least if least < w - low else w - low
        depth[k] = least if least < high - w else high - w


@compiled("i8[::1](f4[:,::1], f8[:,::1], f8[::1], f8, UniTuple(f8[::1], 2), f4[::1])")
def _rays_into_box(
    directions: Single, rotation: Array, sensor: Array, last: float, box: tuple[Array, Array], near: Single
) -> NDArray[np.int64]:
    """Return the indices of the rays that meet a box (low, high) between their near ends and the range `last`.

    The box is convex. If the sensor is inside, exactly the rays with a near end in the box meet it. Otherwise the
    function returns all rays. Rounding errors only add rays.
    """
    low, high = box
    error, faces, inside = rounding(last), np.empty((3, 2), np.float32), True
    for axis in range(3):
        inside &= low[axis] <= sensor[axis] <= high[axis]
        faces[axis, 0] = low[axis] - sensor[axis] - error
        faces[axis, 1] = high[axis] - sensor[axis] + error
    index, depth, count = np.empty(len(near), np.int64), np.float32(last) - near, 0
    if inside:
        _depth_in_box(directions, near, rotation.astype(np.float32), faces, np.float32(last), depth)
    signs = depth.view(np.int32)
    for begin in range(0, len(near), BLOCK):
        block, all_ = signs[begin : begin + BLOCK], np.int32(-1)
        for k in range(len(block)):
            all_ &= block[k]
        if all_ < 0:  # every sign bit is set: all rays of the block begin outside, as those of most blocks do
            continue
        for k in range(len(block)):
            index[count] = begin + k
            count += block[k] >= 0
    return index[:count]


@compiled("void(f4[::1], i8[::1], f4[::1])")
def _gather(values: Single, index: NDArray[np.int64], out: Single) -> None:
    """Write `values[index]`."""
    for s in range(len(index)):
        out[s] = values[index[s]]


@compiled("void(f4[:,::1])")
def derive_rows(capsules: Single) -> None:
    """Compute the rows `TAPER` and `EXTENT` from the others."""
    x, y, z = capsules[NEAR_X], capsules[NEAR_Y], capsules[NEAR_Z]
    u, v, w = capsules[AXIS_X], capsules[AXIS_Y], capsules[AXIS_Z]
    length, near, far = capsules[LENGTH], capsules[NEAR_RADIUS], capsules[FAR_RADIUS]
    taper, extent = capsules[TAPER], capsules[EXTENT]
    least = np.float32(TOUCHING)
    for s in range(capsules.shape[1]):
        taper[s] = (far[s] - near[s]) / (length[s] if length[s] > least else least)
        extent[s] = abs(x[s]) + abs(y[s]) + abs(z[s]) + near[s] + far[s]
        extent[s] += length[s] * (abs(u[s]) + abs(v[s]) + abs(w[s]))


@compiled("f8[:,::1](UniTuple(f8, 4))")
def rotation_matrix(attitude: tuple[float, float, float, float]) -> Array:
    """Return the rotation matrix (3, 3) of a quaternion (w, x, y, z), like `RangeImage.rotation`."""
    a, b, c, d = attitude
    length = math.sqrt(a * a + b * b + c * c + d * d)
    w, x, y, z = a / length, b / length, c / length, d / length
    matrix = np.empty((3, 3))
    matrix[0, 0], matrix[0, 1], matrix[0, 2] = 1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)
    matrix[1, 0], matrix[1, 1], matrix[1, 2] = 2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)
    matrix[2, 0], matrix[2, 1], matrix[2, 2] = 2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)
    return matrix


@compiled(
    "f4[:,::1](f4[:,::1], Tuple((i8[::1], f4[:,::1])), Tuple((UniTuple(f8, 4), UniTuple(f8, 3), UniTuple(f8, 3))),"
    " f8[:,:,::1], UniTuple(f8, 3), f8[::1])"
)
def shadow_capsules(
    free: Single,
    patches: tuple[NDArray[np.int64], Single],
    pose: tuple[tuple[float, float, float, float], tuple[float, float, float], tuple[float, float, float]],
    boxes: Array,
    radii: tuple[float, float, float],
    origin: Array,
) -> Single:
    """Return the capsules (ROWS, n) of all shadows that a body may touch anywhere in the boxes.

    Args:
        free: (E, A) free range F [m] of each beam.
        patches: columns per patch (E,), and the directions (3, n) of the patches' middles in the sensor's frame.
        pose: the sensor's attitude (a quaternion), the robot's position (3,) [m], and the sensor's mount (3,) [m].
        boxes: (2, K, 3) lowest and highest corners of the body's positions [m], world.
        radii: the body's radius [m]; a capsule's growth per metre of range; a capsule's radius at the sensor [m].
        origin: (3,) of the returned coordinates [m], world.
    """
    columns_per_patch, directions = patches
    attitude, position, mount = pose
    body, growth, base = radii
    rotation, sensor, low, high, square = rotation_matrix(attitude), np.empty(3), np.empty(3), np.empty(3), 0.0
    for axis in range(3):
        row = rotation[axis]
        sensor[axis] = position[axis] + row[0] * mount[0] + row[1] * mount[1] + row[2] * mount[2]
        low[axis], high[axis] = boxes[0, :, axis].min(), boxes[1, :, axis].max()
        square += (max(sensor[axis] - low[axis], high[axis] - sensor[axis]) + body) ** 2
    last = (math.sqrt(square) + base) / (1.0 - growth)  # a capsule that begins farther away does not reach the boxes
    low -= body + last * growth + base
    high += body + last * growth + base
    near = patch_minimum(free, columns_per_patch, directions.shape[1])
    index = _rays_into_box(directions, rotation, sensor, last, (low, high), near)
    n = len(index)
    capsules, chosen = np.empty((ROWS, n), np.float32), np.empty((3, n), np.float32)
    begin = np.empty(n, np.float32)
    for axis in range(3):
        _gather(directions[axis], index, chosen[axis])
    _gather(near, index, begin)
    x, y, z = chosen[0], chosen[1], chosen[2]
    for axis in range(3):
        a, b, c = np.float32(rotation[axis, 0]), np.float32(rotation[axis, 1]), np.float32(rotation[axis, 2])
        offset, near_end, along = (
            np.float32(sensor[axis] - origin[axis]),
            capsules[NEAR_X + axis],
            capsules[AXIS_X + axis],
        )
        for s in range(n):
            component = a * x[s] + b * y[s] + c * z[s]
            along[s] = component
            near_end[s] = offset + begin[s] * component
    farthest, single_growth, single_base = np.float32(last), np.float32(growth), np.float32(base)
    length, near_radius, far_radius = capsules[LENGTH], capsules[NEAR_RADIUS], capsules[FAR_RADIUS]
    for s in range(n):
        length[s] = farthest - begin[s]
        near_radius[s] = begin[s] * single_growth + single_base
        far_radius[s] = farthest * single_growth + single_base
    derive_rows(capsules)
    return capsules

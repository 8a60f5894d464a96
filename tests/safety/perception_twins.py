"""Plain NumPy twins of the compiled kernels of perception: the same mathematics, one array operation at a time."""

import numpy as np
from scipy.spatial.transform import Rotation

from brakeline.messaging.obstacle import FARTHEST
from brakeline.safety.filter.halfspaces import TOUCHING
from brakeline.safety.perception.image_coverage import SINGLE
from brakeline.safety.perception.kernels.occlusion_kernels import ALTERNATIONS, RELAXED, SHARED
from brakeline.safety.perception.kernels.shadow_kernels import (
    AXIS_X,
    EXTENT,
    FAR_RADIUS,
    LENGTH,
    NEAR_RADIUS,
    NEAR_X,
    ROUNDING,
    ROUNDING_EXTENT,
    ROWS,
    TAPER,
)

NEAR, AXIS = slice(NEAR_X, NEAR_X + 3), slice(AXIS_X, AXIS_X + 3)

# --- proximity_kernels ------------------------------------------------------------------------------------------------


def window_minimum(values, rows, beside):
    rings, columns = values.shape
    least = np.empty_like(values)
    for i in range(rings):
        band = values[max(i - rows, 0) : i + rows + 1].min(axis=0)
        shifts = range(-min(beside[i], columns), min(beside[i], columns) + 1)
        least[i] = np.min([np.roll(band, shift) for shift in shifts], axis=0)
    return least


def single_beam_ranges(ranges, added, sensor, mesh_window, beam_window, scale):
    far, error, doubt = sensor
    share, rows, beside = mesh_window
    returns = np.where(ranges > 0.0, np.maximum(np.minimum(ranges, far) - error, 0.0), -1.0)
    returns = np.pad(returns, (added, (0, 0)), constant_values=-1.0).astype(np.float32)
    meshes = np.maximum(np.maximum(returns, np.roll(returns, -1, axis=1)), np.float32(0.0))
    meshes[:-1] = np.maximum(meshes[:-1], meshes[1:])
    farthest = (returns / np.float32(share) + np.float32(2.0 * error)).astype(float) * (1.0 + SINGLE)
    ghosts = (returns >= 0.0) & (farthest < window_minimum(meshes, rows, beside))
    returns = np.where(ghosts, np.float32(-1.0), returns)
    if doubt or (returns < 0.0).any():
        return returns, np.empty((0, 0), np.float32)
    return returns, np.minimum(window_minimum(returns, *beam_window) * np.float32(scale[0]), np.float32(scale[1]))


# --- shadow_kernels ---------------------------------------------------------------------------------------------------


def patch_minimum(free, columns_per_patch):
    columns = free.shape[1]
    rings = zip(free, columns_per_patch, strict=True)
    return np.concatenate([np.minimum.reduceat(ring, np.arange(0, columns, width)) for ring, width in rings])


def derive_rows(capsules):
    length, near, far = capsules[LENGTH], capsules[NEAR_RADIUS], capsules[FAR_RADIUS]
    capsules[TAPER] = (far - near) / np.maximum(length, np.float32(TOUCHING))
    capsules[EXTENT] = np.abs(capsules[NEAR]).sum(axis=0) + near + far + length * np.abs(capsules[AXIS]).sum(axis=0)


def shadow_capsules(free, patches, pose, boxes, radii, origin):
    """In double precision. Returns the capsules, and the depth [m] of each patch's near end in the enlarged box."""
    columns_per_patch, directions = patches
    attitude, position, mount = pose
    body, growth, base = radii
    rotation = Rotation.from_quat(np.roll(attitude, -1)).as_matrix()
    sensor = np.asarray(position) + rotation @ mount
    low, high = boxes[0].min(axis=0), boxes[1].max(axis=0)
    last = (np.linalg.norm(np.maximum(sensor - low, high - sensor) + body) + base) / (1.0 - growth)
    margin = body + last * growth + base
    near, ways = patch_minimum(free, columns_per_patch).astype(float), rotation @ directions.astype(float)
    ends = sensor[:, None] + near * ways
    sides = [ends - (low - margin)[:, None], (high + margin)[:, None] - ends, (last - near)[None]]
    depth = np.concatenate(sides).min(axis=0)
    if not ((sensor >= low - margin) & (sensor <= high + margin)).all():
        depth = last - near
    capsules = np.zeros((ROWS, len(near)))
    capsules[NEAR], capsules[AXIS], capsules[LENGTH] = ends - origin[:, None], ways, last - near
    capsules[NEAR_RADIUS], capsules[FAR_RADIUS] = near * growth + base, last * growth + base
    derive_rows(capsules)
    return capsules, depth


# --- occlusion_kernels ------------------------------------------------------------------------------------------------


def groups(ends, first):
    """The first and the last end of each group."""
    return list(zip(first, [*first[1:], len(ends) - 1], strict=True))


def gaps_to(capsules, position):
    off = position.astype(np.float32)[:, None] - capsules[NEAR]
    t = np.clip((off * capsules[AXIS]).sum(axis=0), 0.0, capsules[LENGTH])
    off = off - t * capsules[AXIS]
    return np.sqrt((off * off).sum(axis=0)) - capsules[NEAR_RADIUS] - t * capsules[TAPER]


def group_gaps(capsules, ends, first):
    parts = [[gaps_to(capsules, end) for end in ends[begin : until + 1]] for begin, until in groups(ends, first)]
    return np.array([np.min(part, axis=0) for part in parts], np.float32).reshape(len(first), -1)


def supporting_plane(capsules, index, chord, rounded):
    near, axis = capsules[NEAR, index].astype(float), capsules[AXIS, index].astype(float)
    length, way, share = float(capsules[LENGTH, index]), chord[1] - chord[0], 0.5
    for _ in range(ALTERNATIONS):
        t = np.clip((chord[0] + share * way - near) @ axis, 0.0, length)
        towards = near + t * axis - chord[0] - share * way
        share = np.clip((near + t * axis - chord[0]) @ way / max(way @ way, TOUCHING**2), 0.0, 1.0)
    normal = towards / max(np.linalg.norm(towards), TOUCHING)
    at_near, at_far = normal @ near, normal @ (near + length * axis)
    return normal, min(at_near - capsules[NEAR_RADIUS, index], at_far - capsules[FAR_RADIUS, index]) - rounded


def beyond(capsules, normal, level):
    """How far [m] (n,) each capsule lies beyond a half-space."""
    near = normal @ capsules[NEAR] - level
    far = near + capsules[LENGTH] * (normal @ capsules[AXIS]) - capsules[FAR_RADIUS]
    return np.minimum(near - capsules[NEAR_RADIUS], far)


def supporting_planes(capsules, chords, gaps, reach, most, search):
    keep_off, give, rounded = search
    normals, levels, needed = np.zeros((len(chords), most, 3)), np.full((len(chords), most), FARTHEST), 0
    for group, chord in enumerate(chords):
        open_, k = np.where(gaps[group] > np.float32(reach[group]), np.inf, gaps[group]), 0
        while np.isfinite(open_).any():
            if k == most:
                levels[group, -1] = -np.inf
                break
            nearest = int(open_.argmin())
            normal, level = supporting_plane(capsules, nearest, chord, rounded)
            level -= give * 2.0 ** (k // RELAXED) * max(open_[nearest] - keep_off, 0.0)
            normals[group, k], levels[group, k] = normal, level
            open_[beyond(capsules, normal.astype(np.float32), np.float32(level)) >= rounded] = np.inf
            open_[nearest], k = np.inf, k + 1
        needed = max(needed, k)
    return normals[:, :needed], levels[:, :needed]


def group_periods(ends, shared):
    part = np.floor(np.cumsum(np.linalg.norm(np.diff(ends, axis=0), axis=1)) / shared)
    return np.flatnonzero(np.append(True, part[1:] != part[:-1]))


def count_free_groups(ends, first, gaps, touching):
    parts = groups(ends, first)
    finite = [np.isfinite(ends[begin : until + 1]).all() for begin, until in parts]
    return int(np.logical_and.accumulate((gaps.min(axis=1) > touching) & finite).sum())


def period_planes(planes, first, boxes, growth, margins, offset):
    periods = np.arange(len(growth))
    group = np.searchsorted(first[: len(planes[1])], periods, side="right") - 1
    normals, levels = (np.moveaxis(part[group], 1, 0) for part in planes)
    used = normals.any(axis=2)
    levels = levels - used * (growth + margins[0]) - np.abs(normals) @ margins[1] - normals @ offset
    faces = np.repeat(np.vstack([np.eye(3), -np.eye(3)])[:, None], len(growth), axis=1)
    upper = np.maximum(boxes[1, :-1], boxes[1, 1:]) - offset
    lower = offset - np.minimum(boxes[0, :-1], boxes[0, 1:])
    return np.concatenate([normals, faces]), np.concatenate([levels, upper.T, lower.T])


def group_reach(ends, first, free, boxes, growth, body):
    def corner(position, end):
        return np.linalg.norm(np.maximum(boxes[1, end] - position, position - boxes[0, end]))

    reach = []
    for number, (begin, until) in enumerate(groups(ends, first)[:free]):
        step = np.linalg.norm(np.diff(ends[begin : until + 1], axis=0), axis=1).max(initial=0.0)
        most, last = max(corner(ends[end], end) for end in range(begin, until + 1)) + 0.5 * step, until
        if number == free - 1:
            last = len(ends) - 1
            most = max(most, *(corner(ends[until], end) for end in range(until, len(ends))))
        reach.append(most + body + growth[last - 1])
    return np.array(reach)


def path_planes(capsules, origin, plan, motion, margins, search):
    """For capsules and boxes that are finite."""
    start, nominal, boxes = plan
    ends = np.vstack([start, nominal]) - origin
    boxes = np.broadcast_to(boxes, (2, len(ends), 3)) - origin
    growth = motion[0] + motion[1] * np.arange(1.0, len(ends))
    first = group_periods(ends, SHARED)
    rounded = ROUNDING * max(1.0, (capsules[EXTENT].max() + np.abs(boxes).max()) / ROUNDING_EXTENT)
    gaps = group_gaps(capsules, ends, first)
    free = count_free_groups(ends, first, gaps, TOUCHING)
    none = np.zeros((1, 0, 3)), np.zeros((1, 0))
    if free == 0:
        normals, levels = period_planes(none, first, boxes, growth, margins, ends[0])
        return normals, np.full_like(levels, -np.inf)
    chords = np.array([[ends[begin], ends[until]] for begin, until in groups(ends, first)[:free]])
    reach = group_reach(ends, first, free, boxes, growth, margins[0] + margins[1].sum() + rounded)
    planes = supporting_planes(capsules, chords, gaps[:free], reach, search[0], (margins[0], search[1], rounded))
    return period_planes(planes, first, boxes, growth, margins, ends[0])

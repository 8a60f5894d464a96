"""Exact ranges along rays to obstacles, computed from what the words mean and not from the closest points."""

import numpy as np

from brakeline.messaging.obstacle import BOX, CYLINDER, SPHERE, WALL, Obstacle, rotate


def cast(obstacles, at, ways, far):
    """Return the ranges (...) [m] from points (d,) or (..., d) along unit vectors (..., d) to a solid, or `far`."""
    ranges = np.full(ways.shape[:-1], far)
    for obstacle in obstacles:
        enters, leaves = crossing(
            obstacle, rotate(at - np.array(obstacle.position), -obstacle.yaw), rotate(ways, -obstacle.yaw)
        )
        hit = (enters <= leaves) & (leaves >= 0.0)
        ranges[hit] = np.minimum(ranges, np.maximum(enters, 0.0))[hit]
    return ranges


def crossing(obstacle: Obstacle, start, ways):
    """Return where rays enter and leave a solid [m], in its frame; a solid is what slabs and a round body share."""
    kind, size, d = obstacle.kind, obstacle.size, ways.shape[-1]
    slabs = np.array([[-np.inf], [np.inf]]).repeat(d, axis=1)
    if kind == BOX:
        slabs = np.array([[-0.5], [0.5]]) * size
    elif kind == WALL:
        slabs[1, 0] = 0.0
    elif kind == CYLINDER and d == 3:
        slabs[:, 2] = -0.5 * size[1], 0.5 * size[1]
    with np.errstate(divide="ignore"):
        between = np.stack([(slab - start) / ways for slab in slabs])
    enters, leaves = between.min(axis=0).max(axis=-1), between.max(axis=0).min(axis=-1)
    if kind in (CYLINDER, SPHERE):
        middle, across = (part[..., : 2 if kind == CYLINDER else d] for part in (start, ways))
        length, along = np.maximum((across * across).sum(axis=-1), 1e-300), (across * middle).sum(axis=-1)
        inside = along * along - length * ((middle * middle).sum(axis=-1) - size[0] ** 2)
        half = np.sqrt(np.where(inside < 0.0, np.nan, inside))  # NaN: the ray passes by
        enters, leaves = np.fmax(enters, (-along - half) / length), np.fmin(leaves, (-along + half) / length)
        leaves = np.where(inside < 0.0, -np.inf, leaves)
    return enters, leaves

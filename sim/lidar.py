"""A planar lidar: exact ranges along a fan of rays, to discs and to rotated boxes (walls are large boxes)."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from messaging.robots import RAYS
from messaging.shapes import Shapes

Array = NDArray[np.float64]

FAN = np.linspace(-0.5 * math.pi, 0.5 * math.pi, RAYS)  # rad from straight ahead; right to left
MAX_RANGE = 3.5  # m
TINY = 1e-12  # stands for a component of a direction that is zero: 1/TINY is finite, and 0/TINY is not a NaN


def cast(shapes: Shapes, origin: Array, heading: float, max_range: float = MAX_RANGE) -> Array:
    """Ranges (RAYS,) in m from `origin` (2,) along the fan about `heading` (rad); `max_range` where nothing is hit.

    `shapes` are 2-D; each is a box (rho = 0) or a disc (half = 0). Inside one of them every range is 0.
    """
    if not len(shapes):
        return np.full(RAYS, max_range)
    angles = heading + FAN
    rays = np.stack((np.cos(angles), np.sin(angles)))  # (2, RAYS)
    disc = shapes.rho > 0.0
    return np.minimum(
        np.minimum(_to_discs(shapes.center[disc] - origin, shapes.rho[disc], rays, max_range), max_range),
        _to_boxes(shapes.take(~disc), origin, rays, max_range),
    )


def _to_discs(offset: Array, radius: Array, rays: Array, max_range: float) -> Array:
    """Ranges (RAYS,) to discs of `radius` (n,) at `offset` (n, 2): the smaller root t of |t·ray − offset| = radius."""
    along = offset @ rays  # (n, RAYS)
    beyond = (offset * offset).sum(axis=1) - radius * radius  # negative inside
    square = along * along - beyond[:, None]
    near = along - np.sqrt(np.maximum(square, 0.0))
    hit = (square >= 0.0) & (along > 0.0) & (beyond[:, None] > 0.0)
    ranges = np.where(hit, near, max_range)
    ranges[beyond <= 0.0] = 0.0
    return np.asarray(ranges.min(axis=0, initial=max_range))


def _to_boxes(boxes: Shapes, origin: Array, rays: Array, max_range: float) -> Array:
    """Ranges (RAYS,) to rotated boxes: a ray is inside from the last pair of sides it enters to the first it leaves."""
    turned = boxes.axes.transpose(0, 2, 1)
    local = turned @ (origin - boxes.center)[:, :, None]  # (n, 2, 1)
    direction = turned @ rays  # (n, 2, RAYS)
    inverse = 1.0 / np.where(np.abs(direction) < TINY, TINY, direction)
    middle = -local * inverse
    reach = boxes.half[:, :, None] * np.abs(inverse)
    enter = (middle - reach).max(axis=1)  # (n, RAYS)
    leave = (middle + reach).min(axis=1)
    ranges = np.where((enter <= leave) & (leave >= 0.0), np.maximum(enter, 0.0), max_range)
    return np.asarray(ranges.min(axis=0, initial=max_range))

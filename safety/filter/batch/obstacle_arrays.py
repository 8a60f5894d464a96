"""The arrays of a batch: obstacles, the distances from points to them (docs/method.md §3), and rotations."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields
from typing import Any, NamedTuple, TypeVar

import array_api_compat
import numpy as np
from numpy.typing import NDArray

from brakeline.messaging.obstacle import LARGEST, ORTHONORMAL, Shapes

T = TypeVar("T")
Array = Any  # of any namespace
Axes = list[Array]  # one array for each axis

TINY = 1e-300


def on_host(array: Array) -> NDArray[Any]:
    """Return a copy of an array of any namespace and device as NumPy's own."""
    numbers = array if isinstance(array, np.ndarray) else np.from_dlpack(array_api_compat.to_device(array, "cpu"))
    return np.array(numbers)


def mapped(whole: T, change: Callable[[Array], Array]) -> T:
    """Return a nested value with every array changed. Flags, numbers, texts, plain tuples and None stay as they are."""
    part: Any = whole
    if isinstance(part, list):
        part = [mapped(one, change) for one in part]
    elif hasattr(part, "_fields"):  # a named tuple
        part = type(part)(*(mapped(one, change) for one in part))
    elif hasattr(part, "__dataclass_fields__"):
        part = type(part)(*(mapped(getattr(part, field.name), change) for field in fields(part)))
    elif not (part is None or isinstance(part, int | float | str | tuple)):
        part = change(part)
    return part  # type: ignore[no-any-return]


class TurnBatch(NamedTuple):
    """The cosines and sines (B,) of the headings; None for robots without a heading, whose frame is the world's."""

    cos: Array
    sin: Array

    def to_world(self, robot: Axes) -> Axes:
        """Return vectors, per axis (..., B), in the world from vectors in the robots' frames."""
        if self.cos is None:
            return robot
        return [self.cos * robot[0] - self.sin * robot[1], self.sin * robot[0] + self.cos * robot[1], *robot[2:]]

    def to_robot(self, world: Axes) -> Axes:
        """Return vectors, per axis (..., B), in the robots' frames from vectors in the world."""
        if self.cos is None:
            return world
        return [self.cos * world[0] + self.sin * world[1], self.cos * world[1] - self.sin * world[0], *world[2:]]


@dataclass(frozen=True)
class ObstacleArrays:
    """Up to K obstacles for each of B requests, as `Shapes` has them. Row b uses its first `count[b]` slots.

    >>> from brakeline.messaging.obstacle import Obstacle
    >>> post = Shapes.of([Obstacle("cylinder", (0.4, 0.0), (0.1,))], dim=2)
    >>> ObstacleArrays.of([post, Shapes.of([], dim=2)]).count.tolist()
    [1, 0]

    Attributes:
        center (B, K, d): see `Shapes`.
        axes (B, K, d, d): see `Shapes`.
        half (B, K, d): see `Shapes`.
        rho (B, K): see `Shapes`.
        round (B, K, d): see `Shapes`.
        margin (B, K): see `Shapes`.
        count (B,): number of obstacles of each request, integers.
    """

    center: Array
    axes: Array
    half: Array
    rho: Array
    round: Array
    margin: Array
    count: Array

    @property
    def slots(self) -> int:
        """K; 0 if `rho` has another number of dimensions than 2."""
        return int(self.rho.shape[1]) if self.rho.ndim == 2 else 0

    def row_shapes(self, d: int) -> dict[str, tuple[int, ...]]:
        """Return the shape that one row of each array has, in d dimensions."""
        return Shapes.sizes(self.slots, d) | {"count": ()}

    @staticmethod
    def of(shapes: Sequence[Shapes]) -> ObstacleArrays:
        """Pad the obstacles of B requests to the same number. All have the same number of dimensions."""
        count = np.array([len(one) for one in shapes], dtype=np.int64)
        most, used = int(count.max(initial=0)), np.repeat(np.arange(len(shapes)), count)
        slot = np.arange(int(count.sum())) - np.repeat(np.cumsum(count) - count, count)

        def padded(name: str) -> Array:
            flat = np.concatenate([getattr(one, name) for one in shapes])
            part = np.zeros((len(shapes), most, *flat.shape[1:]))
            part[used, slot] = flat
            return part

        center, axes, half, rho, rounded, margin = (padded(field.name) for field in fields(Shapes))
        return ObstacleArrays(center, axes, half, rho, rounded, margin, count)

    def of_row(self, row: int) -> Shapes:
        """Return the obstacles of one request, as NumPy arrays."""
        count = int(self.count[row])
        parts = (on_host(getattr(self, field.name)[row][:count]) for field in fields(Shapes))
        return Shapes(*map(np.ascontiguousarray, parts))


@dataclass(frozen=True)
class NearObstacles:
    """The obstacles within reach, batch last: per axis (K, B); axes[j][i] is entry (j, i) of the rotations."""

    center: Axes
    axes: list[Axes]
    half: Axes
    rho: Array
    round: Axes
    margin: Array
    used: Array  # (K, B): whether the slot holds an obstacle
    slot: Array  # (K, B): its index among the request's obstacles
    away: Array  # (K, B) [m]: distance from the measured position, less the obstacle's margin

    def none(self, xp: Any, lanes: Array) -> Array:
        """Return which lanes (B,) have no obstacle; `lanes` is any array (B,) of them."""
        return xp.all(~self.used, axis=0) if self.used.shape[0] else xp.ones_like(lanes, dtype=xp.bool)


def within_reach(
    xp: Any, obstacles: ObstacleArrays, start: Axes, reach: Array, least_margin: float
) -> tuple[NearObstacles, Array]:
    """Return the obstacles within reach (B,) of positions `start` (per axis, (B,)), and the distance to the next one.

    The distance (B,) [m] is that of the nearest obstacle beyond reach, or infinity. A margin below `least_margin` [m]
    counts as that (`Robot.least_margin`).
    """
    d = len(start)

    def last(part: Array) -> Array:
        return xp.asarray(xp.permute_dims(part, (1, 0)), copy=True)

    parts = [[last(part[..., i]) for i in range(d)] for part in (obstacles.center, obstacles.half, obstacles.round)]
    axes = [[last(obstacles.axes[..., j, i]) for i in range(d)] for j in range(d)]
    rho, margin = last(obstacles.rho), last(obstacles.margin)
    slot = xp.broadcast_to(xp.arange(rho.shape[0], device=rho.device)[:, None], rho.shape)
    used = slot < obstacles.count
    whole = NearObstacles(parts[0], axes, parts[1], rho, parts[2], margin, used, slot, rho)
    _, distance = towards(xp, whole, [axis[None] for axis in start])
    away = distance[0] - xp.maximum(margin, xp.full_like(margin, least_margin))
    near = used & ~(away > reach)
    beyond = xp.min(xp.where(used & ~near, away, xp.inf), axis=0) if rho.shape[0] else xp.full_like(reach, xp.inf)
    most = int(xp.max(xp.sum(xp.astype(near, xp.int64), axis=0))) if rho.shape[0] else 0
    order = xp.argsort(xp.astype(~near, xp.int8), axis=0, stable=True) if rho.shape[0] else slot
    whole = NearObstacles(parts[0], axes, parts[1], rho, parts[2], margin, near, slot, away)
    return mapped(whole, lambda part: xp.take_along_axis(part, order[:most], axis=0)), beyond


def plausible(xp: Any, obstacles: ObstacleArrays) -> Array:
    """Return the requests (B,) whose obstacles all have possible numbers, as `shape_kernels.plausible` of `Shapes`."""
    count, d = obstacles.count[:, None], obstacles.center.shape[2]
    slot = xp.arange(obstacles.rho.shape[1], device=obstacles.rho.device)
    good = (xp.abs(obstacles.margin) <= LARGEST) & (obstacles.rho >= 0.0) & (obstacles.rho <= LARGEST)
    for i in range(d):
        half, rounded = obstacles.half[..., i], obstacles.round[..., i]
        good &= (xp.abs(obstacles.center[..., i]) <= LARGEST) & (half >= 0.0) & (half <= LARGEST)
        good &= (rounded == 0.0) | (rounded == 1.0)
        for k in range(i + 1):
            product = _summed([obstacles.axes[..., j, i] * obstacles.axes[..., j, k] for j in range(d)])
            good &= xp.abs(product - float(i == k)) <= ORTHONORMAL
    return xp.all(good | (slot >= count), axis=1)


def towards(xp: Any, near: NearObstacles, points: Axes) -> tuple[Axes, Array]:
    """Return vectors from points (per axis, (Q, B)) to the closest points of each obstacle, and their lengths.

    Per axis (Q, K, B), and (Q, K, B). Both are zero inside an obstacle.
    """
    d = len(points)
    away = [points[j][:, None] - near.center[j] for j in range(d)]
    rest = []
    for i in range(d):
        local = _summed([away[j] * near.axes[j][i] for j in range(d)])
        rest.append(local - xp.minimum(xp.maximum(local, -near.half[i]), near.half[i]))
    square = _summed([(rest[i] * near.round[i]) ** 2 for i in range(d)])
    share = near.rho / xp.maximum(xp.sqrt(square), xp.maximum(near.rho, xp.full_like(near.rho, TINY)))
    rest = [rest[i] - rest[i] * near.round[i] * share for i in range(d)]
    way = [_summed([-rest[i] * near.axes[j][i] for i in range(d)]) for j in range(d)]
    return way, xp.sqrt(_summed([part * part for part in way]))


def _summed(parts: list[Array]) -> Array:
    return sum(parts[1:], parts[0])

"""Free space from a range image: what it does not show to be free lies in shadows of patches (docs/method.md §10).

The shadow of a patch is what is in it beyond F (`safety/perception/image_coverage.py`). Thousands of them are kept
off by a few
half-spaces a period: the one that supports the nearest shadow, then, of all that are not beyond it, the one that
supports the nearest of these, until none is left.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache, lru_cache

import numpy as np
from numpy.typing import NDArray

from brakeline.messaging.obstacle import FARTHEST
from brakeline.messaging.range_image import RangeImage, directions
from brakeline.safety.filter.halfspaces import TOUCHING
from brakeline.safety.perception.image_coverage import BeamGrid, patch_free_ranges

Array = NDArray[np.float64]
Single = NDArray[np.float32]

PLANES = 32  # of a period at most: what needs more has no free space there
GIVE = 0.05  # of the room to a shadow, that is given up for fewer half-spaces; twice as much after every eight
SHARED = 0.6  # m of the nominal way, about, along which periods share half-spaces
ASIDE = 1e-6  # rad: more than a direction in single precision is beside its patch's middle
FACES = np.vstack([np.eye(3), -np.eye(3)])  # of the room


@dataclass(frozen=True)
class PlanBoxes:
    """Boxes, world, that no plan is outside of at the periods' ends, now the first of them, until so many s from now:
    their lowest and highest corners (2, N+1, 3), or of one for all (2, 1, 3)."""

    boxes: Array
    last: float


@dataclass(frozen=True)
class OccludedRegions:
    """n of them, as `lines` (11, n) from their near ends to their far ones, from an origin (3,), world: `casting.py`
    says what a line is, and the hull of balls about both ends holds the shadow. room: all that come into it. speed
    [m/s]: whatever they hold may move as fast since `age` s ago."""

    lines: Single
    origin: Array
    room: PlanBoxes
    speed: float
    age: float


def prepare() -> None:
    """Compile what reads range images, or load it: before the first one is to be answered in time."""
    import brakeline.safety.perception.kernels.proximity_kernels  # noqa: F401

    _compiled()


@cache  # importing anew what there is takes a fiftieth of a decision
def _compiled() -> tuple[Callable[..., Single], Callable[..., tuple[Array, Array]]]:
    from brakeline.safety.perception.kernels.occlusion_kernels import about_way
    from brakeline.safety.perception.kernels.shadow_kernels import behind

    return behind, about_way


def occluded_regions(image: RangeImage, room: PlanBoxes, body: float, origin: Array) -> OccludedRegions:
    """All that is not known to be free and that a body of that radius [m], with its middle in the room, may touch; from
    an origin (3,) in the room."""
    grid, free = patch_free_ranges(image)
    beside = body + image.speed * (image.age + room.last)
    about = grid.half_diagonal + image.angle_error + ASIDE
    pose = image.attitude, image.at, image.mount
    behind, _ = _compiled()
    lines = behind(free, *_patches(grid), *pose, room.boxes, beside, about, image.sensor_error, origin)
    return OccludedRegions(lines, origin, room, image.speed, image.age)


@lru_cache(maxsize=16)
def _patches(grid: BeamGrid) -> tuple[NDArray[np.int64], Single]:
    """How many columns make a patch in each ring (E,), more than one near the poles, and their middles (3, n), as
    exactly as `ASIDE`."""
    elevations, columns = grid.elevations, grid.columns
    half = 0.5 * float(np.diff(elevations).max())  # the outermost rings may have been moved to the poles
    together = (1.0 / np.cos(np.maximum(np.abs(elevations) - half, 0.0))).astype(np.int64)
    middles = []
    for elevation, each in zip(elevations, together, strict=True):
        begin = np.arange(0, columns, each)
        middle = 0.5 * (begin + np.minimum(begin + each, columns) - 1)
        middles.append(directions(np.array([elevation]), columns, middle)[0])
    return together, np.ascontiguousarray(np.concatenate(middles).T, np.float32)


def half_spaces(
    near: OccludedRegions, start: Array, nominal: Array, keep_off: float, measured: Array, period: float
) -> tuple[Array, Array]:
    """As `freespace.half_spaces`: as many as any period needs, up to `PLANES`, and the room's faces. Those that a
    period does not need hold everywhere."""
    boxes, moved = near.room.boxes, (near.speed * near.age, near.speed * period)  # m: until now, and in a period
    way, limits = np.ascontiguousarray(nominal), (SHARED, TOUCHING, GIVE, FARTHEST)
    _, about_way = _compiled()
    return about_way(near.lines, near.origin, start, way, boxes, moved, keep_off, measured, PLANES, limits)

"""Free space from a range image: everything that the image does not show to be free is a shadow (docs/method.md §10).

A patch is a group of neighbouring beams. Its shadow is the space beyond its free range F (`image_coverage.py`). A few
half-spaces for each period keep the plan off thousands of shadows. The first half-space touches the nearest shadow. The
next touches the nearest shadow that is not beyond the first, and so on until every shadow is beyond one.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache, lru_cache

import numpy as np
from numpy.typing import NDArray

from brakeline.messaging.range_image import Array, RangeImage, directions
from brakeline.safety.perception.image_coverage import BeamGrid, patch_free_ranges

Single = NDArray[np.float32]

PLANES = 32  # half-spaces of a period at most; a period that needs more has no free space
GIVE = 0.05  # share of the gap to a shadow that is given up for fewer half-spaces; it doubles after every eight
DIRECTION_ERROR = 1e-6  # rad: largest error of a direction in single precision


@dataclass(frozen=True)
class PlanBoxes:
    """Boxes that hold every plan's position at the ends of the periods, in the world's frame."""

    boxes: Array  # (2, N+1, 3) lowest and highest corners [m], the first for now; or (2, 1, 3), one box for all ends
    last: float  # time of the last end [s from now]


@dataclass(frozen=True)
class OccludedRegions:
    """The n shadows of a range image that come into the boxes of a plan."""

    capsules: Single  # (ROWS, n) hulls of the shadows, relative to the origin (`kernels/shadow_kernels.py`)
    origin: Array  # (3,) [m], world
    room: PlanBoxes  # the boxes
    speed: float  # largest speed of anything in a shadow [m/s]
    age: float  # time since the image was taken [s]


def prepare() -> None:
    """Compile or load the kernels that read range images, so that the first image is answered in time."""
    import brakeline.safety.perception.kernels.proximity_kernels  # noqa: F401

    _kernels()


@cache  # an import statement at each call would cost a fiftieth of a decision
def _kernels() -> tuple[Callable[..., Single], Callable[..., tuple[Array, Array]]]:
    from brakeline.safety.perception.kernels.occlusion_kernels import path_planes
    from brakeline.safety.perception.kernels.shadow_kernels import shadow_capsules

    return shadow_capsules, path_planes


def occluded_regions(image: RangeImage, room: PlanBoxes, body: float, origin: Array) -> OccludedRegions:
    """Return the shadows that a body may touch in the boxes.

    Args:
        image: what the sensor measured.
        room: boxes of the body's positions.
        body: the body's radius [m].
        origin: (3,) a point in the boxes [m], world.
    """
    shadow_capsules, _ = _kernels()
    grid, free = patch_free_ranges(image)
    reach = body + image.speed * (image.age + room.last)
    angle = grid.half_diagonal + image.angle_error + DIRECTION_ERROR
    pose = image.attitude, image.at, image.mount
    capsules = shadow_capsules(free, _patches(grid), pose, room.boxes, (reach, angle, image.sensor_error), origin)
    return OccludedRegions(capsules, origin, room, image.speed, image.age)


@lru_cache(maxsize=16)
def _patches(grid: BeamGrid) -> tuple[NDArray[np.int64], Single]:
    """Return the columns per patch of each ring (E,), more than one near the poles, and the patches' middles (3, n).

    The middles are unit vectors in the sensor's frame, within `DIRECTION_ERROR`.
    """
    elevations, columns = grid.elevations, grid.columns
    half = 0.5 * float(np.diff(elevations).max())  # the outermost rings may have been moved to the poles
    columns_per_patch = (1.0 / np.cos(np.maximum(np.abs(elevations) - half, 0.0))).astype(np.int64)
    middles = []
    for elevation, width in zip(elevations, columns_per_patch, strict=True):
        begin = np.arange(0, columns, width)
        middle = 0.5 * (begin + np.minimum(begin + width, columns) - 1)
        middles.append(directions(np.array([elevation]), columns, middle)[0])
    return columns_per_patch, np.ascontiguousarray(np.concatenate(middles).T, np.float32)


def half_spaces(
    near: OccludedRegions, start: Array, nominal: Array, keep_off: float, measured: Array, period: float
) -> tuple[Array, Array]:
    """Return half-spaces like `halfspaces.half_spaces`: up to `PLANES` for each period, and the boxes' faces.

    A half-space that a period does not need holds everywhere. period: duration of a period [s].
    """
    _, path_planes = _kernels()
    plan = start, np.ascontiguousarray(nominal), near.room.boxes
    motion = near.speed * near.age, near.speed * period
    planes: tuple[Array, Array] = path_planes(
        near.capsules, near.origin, plan, motion, (keep_off, measured), (PLANES, GIVE)
    )
    return planes

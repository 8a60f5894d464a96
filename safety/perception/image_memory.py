"""What a sensor with beams all about saw free before (`safety/perception/visibility_memory.py`)."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from brakeline.messaging.range_image import RangeImage, directions
from brakeline.messaging.robot import Robot
from brakeline.messaging.scan import Scan
from brakeline.safety.perception.image_coverage import GridWindow, Single, meshes, patch_free_ranges
from brakeline.safety.perception.visibility_memory import FanMemory, VisibilityMemory

Array = NDArray[np.float64]

KEPT = 4  # images
APART = 0.5  # m between two that are kept
# Along a beam, m.
AWAY = np.concatenate([np.arange(0.05, 1.0, 0.05), np.arange(1.0, 3.0, 0.25), np.arange(3.0, 8.0, 0.5)])
STEPS = np.diff(AWAY, prepend=0.0)
ASIDE = tuple(math.radians(angle) for angle in (2.0, 5.0, 10.0, 20.0, 40.0))  # that drift may be seen under


@dataclass(frozen=True, eq=False)
class _Seen:
    image: RangeImage

    @cached_property
    def free(self) -> tuple[float, Single]:
        """The lowest ring's elevation [rad], and the free ranges (len(ASIDE), E, A) of all directions within so much of
        each patch."""
        grid, free = patch_free_ranges(self.image)
        about, elevations = 2.0 * grid.half_diagonal, grid.elevations
        columns, step = grid.columns, self.image.step[0]
        levels = [GridWindow.of(columns, elevations, step, aside + about).least(free) for aside in ASIDE]
        return float(elevations[0]), np.stack(levels)


class ImageMemory(VisibilityMemory[RangeImage]):
    """Of an image all about."""

    START = 0.7  # what flies needs more to get going
    nothing = RangeImage(np.zeros((16, 32)), (0.0, 0.0, 0.0))

    def __init__(self, footprint: float) -> None:
        import brakeline.safety.perception.kernels.proximity_kernels  # noqa: F401  # compiled now, and not when the first image is to be answered in time

        super().__init__(footprint)

    def reset(self) -> None:
        super().reset()
        self._seen: deque[_Seen] = deque(maxlen=KEPT)

    def _own(self, scan: RangeImage) -> RangeImage:
        return replace(scan, ranges=scan.ranges.copy())

    def _wanted(self, scan: RangeImage) -> NDArray[np.bool_]:
        """Those that none of a mesh speaks for: single ones cost little."""
        none = ~meshes(np.logical_or, scan.known)
        none |= np.roll(none, 1, axis=1)
        none[1:] |= none[:-1].copy()
        return np.asarray(none & ~scan.known)

    def _keep(self, scan: RangeImage) -> None:
        if self._seen and math.dist(self._seen[-1].image.at, scan.at) < APART:
            return
        if len(self._seen) == KEPT:
            self._before.pop(0)
        self._seen.append(_Seen(scan))
        self._before.append(scan.age)

    def _along(self, scan: RangeImage, beams: NDArray[np.bool_]) -> Array:
        elevations = scan.low + scan.step[0] * np.arange(len(scan.ranges))
        ways = directions(elevations, scan.ranges.shape[1])[beams] @ scan.turn.T
        points = scan.sensor() + AWAY[:, None, None] * ways  # (S, B, 3)
        free = self._at_start(points, scan, STEPS[:, None])
        for seen, age in zip(self._seen, self._before, strict=True):
            free |= self._in(seen, age, points, scan)
        steps = np.where(free.all(axis=0), len(AWAY), free.argmin(axis=0))
        return np.concatenate([[0.0], AWAY])[steps]

    def _in(self, seen: _Seen, age: float, points: Array, scan: RangeImage) -> NDArray[np.bool_]:
        """Was it seen free, with all that is within the errors since?"""
        away = (points - seen.image.sensor()) @ seen.image.turn
        far = np.sqrt(np.einsum("sbd,sbd->sb", away, away))
        drift = seen.image.sensor_error + scan.position_error + scan.speed * age + STEPS[:, None]
        reach = np.linalg.norm(points - np.asarray(scan.at), axis=-1)
        drift = drift + seen.image.angle_error * far + scan.angle_error * reach
        aside = np.arcsin(np.minimum(drift / np.maximum(far, 1e-9), 1.0))
        level = np.searchsorted(np.array(ASIDE), aside)
        lowest, free = seen.free
        _, rings, columns = free.shape
        up = np.arcsin(np.clip(away[..., 2] / np.maximum(far, 1e-9), -1.0, 1.0))
        ring = np.clip(np.rint((up - lowest) / seen.image.step[0]).astype(int), 0, rings - 1)
        column = np.rint(np.arctan2(away[..., 1], away[..., 0]) * (columns / math.tau)).astype(int) % columns
        least = free[np.minimum(level, len(ASIDE) - 1), ring, column]
        return np.asarray((far + drift < least) & (level < len(ASIDE)))


def memory_of(robot: Robot) -> FanMemory | ImageMemory:
    """What a robot's asker remembers of what its sensor saw."""
    return FanMemory(robot.footprint) if robot.position_dim == 2 else ImageMemory(robot.footprint)


def filled(memory: FanMemory | ImageMemory, info: Mapping[str, Any], elapsed: float) -> Scan | RangeImage | None:
    """The scan in an environment's `info`, with what is remembered; one that the memory is not of, as it is.

    A scan that is None did not come: the last one counts, so much older. None: the environment never had a `scan`.
    """
    if "scan" not in info and memory.unused:
        return None
    scan = info.get("scan")
    if isinstance(memory, FanMemory) and not isinstance(scan, RangeImage):
        return memory.fill(scan, elapsed)
    if isinstance(memory, ImageMemory) and not isinstance(scan, Scan):
        return memory.fill(scan, elapsed)
    return scan

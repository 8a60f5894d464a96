"""Memory of free space for a sensor with beams in all directions (`visibility_memory.py`)."""

from __future__ import annotations

import logging
import math
from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from brakeline.messaging.range_image import RangeImage, directions
from brakeline.messaging.robot import Array, Robot
from brakeline.messaging.scan import Scan
from brakeline.safety.perception.image_coverage import GridWindow, Single, by_mesh, patch_free_ranges, unseen_poles
from brakeline.safety.perception.visibility_memory import FanMemory, VisibilityMemory

log = logging.getLogger(__name__)

CAPACITY = 4  # images
SPACING = 0.5  # m: smallest motion between two stored images
# m: the tested points along a beam.
DISTANCES = np.concatenate([np.arange(0.05, 1.0, 0.05), np.arange(1.0, 3.0, 0.25), np.arange(3.0, 8.0, 0.5)])
STEPS = np.diff(DISTANCES, prepend=0.0)
DRIFT_ANGLES = tuple(math.radians(angle) for angle in (2.0, 5.0, 10.0, 20.0, 40.0))  # under which drift may appear


@dataclass(frozen=True, eq=False)
class _StoredImage:
    image: RangeImage

    @cached_property
    def free(self) -> tuple[float, Single]:
        """The lowest ring's elevation [rad], and the free ranges (len(DRIFT_ANGLES), E, A) [m].

        Entry k of the ranges is the least free range of all directions within `DRIFT_ANGLES[k]` of a patch.
        """
        grid, free = patch_free_ranges(self.image)
        patch, step = 2.0 * grid.half_diagonal, self.image.step[0]
        windows = [GridWindow.of(grid.columns, grid.elevations, step, angle + patch) for angle in DRIFT_ANGLES]
        return float(grid.elevations[0]), np.stack([window.minimum(free) for window in windows])


class ImageMemory(VisibilityMemory[RangeImage]):
    """Memory of a sensor with beams in all directions."""

    START = 0.7  # a flying robot needs more room to get going
    nothing = RangeImage(np.zeros((16, 32)), (0.0, 0.0, 0.0))

    def __init__(self, footprint: float) -> None:
        import brakeline.safety.perception.kernels.proximity_kernels  # noqa: F401  # compiles now, not at the first image

        super().__init__(footprint)

    def reset(self) -> None:
        super().reset()
        self._stored: deque[_StoredImage] = deque(maxlen=CAPACITY)

    def fill(self, scan: RangeImage | None, elapsed: float) -> RangeImage:
        """Fill in the image. A log record says so if the first one lacks beams without which nothing can fly."""
        if scan is not None and self.unused and (lacking := unseen_poles(scan)):
            log.warning("the robot will not fly: %s", lacking)
        return super().fill(scan, elapsed)

    def _copied(self, scan: RangeImage) -> RangeImage:
        return replace(scan, ranges=scan.ranges.copy())

    def _beams_to_fill(self, scan: RangeImage) -> NDArray[np.bool_]:
        """Return the unknown beams next to a mesh without any known beam. Single unknown beams cost little."""
        none = ~by_mesh(np.logical_or, scan.valid_beams)
        none |= np.roll(none, 1, axis=1)
        none[1:] |= none[:-1].copy()
        return np.asarray(none & ~scan.valid_beams)

    def _store(self, scan: RangeImage) -> None:
        if self._stored and math.dist(self._stored[-1].image.at, scan.at) < SPACING:
            return
        self._stored.append(_StoredImage(scan))
        self._ages = [*self._ages, scan.age][-CAPACITY:]

    def _free_along(self, scan: RangeImage, beams: NDArray[np.bool_]) -> Array:
        elevations = scan.low + scan.step[0] * np.arange(len(scan.ranges))
        ways = directions(elevations, scan.ranges.shape[1])[beams] @ scan.rotation.T
        points = scan.sensor() + DISTANCES[:, None, None] * ways  # (S, B, 3)
        free = self._near_start(points, scan, STEPS[:, None])
        for stored, age in zip(self._stored, self._ages, strict=True):
            free |= self._shown_free(stored, age, points, scan)
        steps = np.where(free.all(axis=0), len(DISTANCES), free.argmin(axis=0))
        return np.concatenate([[0.0], DISTANCES])[steps]

    def _shown_free(self, stored: _StoredImage, age: float, points: Array, scan: RangeImage) -> NDArray[np.bool_]:
        """Return which points a stored image shows to be free, with everything within the errors around them."""
        image = stored.image
        away = (points - image.sensor()) @ image.rotation
        far = np.sqrt(np.einsum("sbd,sbd->sb", away, away))
        drift = image.sensor_error + scan.position_error + scan.speed * age + STEPS[:, None]
        reach = np.linalg.norm(points - np.asarray(scan.at), axis=-1)
        drift = drift + image.angle_error * far + scan.angle_error * reach
        aside = np.arcsin(np.minimum(drift / np.maximum(far, 1e-9), 1.0))
        level = np.searchsorted(np.array(DRIFT_ANGLES), aside)
        lowest, free = stored.free
        _, rings, columns = free.shape
        elevation = np.arcsin(np.clip(away[..., 2] / np.maximum(far, 1e-9), -1.0, 1.0))
        ring = np.clip(np.rint((elevation - lowest) / image.step[0]).astype(int), 0, rings - 1)
        column = np.rint(np.arctan2(away[..., 1], away[..., 0]) * (columns / math.tau)).astype(int) % columns
        least = free[np.minimum(level, len(DRIFT_ANGLES) - 1), ring, column]
        return np.asarray((far + drift < least) & (level < len(DRIFT_ANGLES)))


def memory_of(robot: Robot) -> FanMemory | ImageMemory:
    """Return an empty memory for a robot's sensor.

    >>> from brakeline import robot_named
    >>> memory_of(robot_named("ground")).unused
    True

    Raises:
        TypeError: `robot` is no robot.
    """
    if not isinstance(robot, Robot):
        raise TypeError(
            f"memory_of takes a robot, such as `filter.robot` or `client.robot`, not a {type(robot).__name__}"
        )
    return FanMemory(robot.footprint) if robot.position_dim == 2 else ImageMemory(robot.footprint)


def filled(memory: FanMemory | ImageMemory, info: Mapping[str, Any], elapsed: float) -> Scan | RangeImage | None:
    """Return `info["scan"]` of an environment, with unknown beams filled in from memory.

    >>> from brakeline import robot_named
    >>> filled(memory_of(robot_named("ground")), {}, elapsed=0.2) is None
    True

    Args:
        memory: of the robot. A scan of the other kind is returned unchanged.
        info: an environment's. A `scan` of None means that none came: the last one counts, and ages.
        elapsed: time since the last call [s].

    Returns:
        The scan, or None if no `scan` ever came. An episode that begins without one begins with nothing free.

    Raises:
        BadRequest: `elapsed` is negative or not finite; then all in memory counts as too old.
        TypeError: `info` is no mapping.
    """
    if not isinstance(info, Mapping):
        raise TypeError(f'filled takes a dict, such as {{"scan": scan}}, not a {type(info).__name__}')
    if "scan" not in info and memory.unused:
        return None
    scan = info.get("scan")
    if isinstance(memory, FanMemory) and not isinstance(scan, RangeImage):
        return memory.fill(scan, elapsed)
    if isinstance(memory, ImageMemory) and not isinstance(scan, Scan):
        return memory.fill(scan, elapsed)
    return scan

"""How far a range image shows each patch about a beam to be free.

Take a point p of an obstacle, d from the sensor. A cube of any edge w up to the least width W has its corner there and
lies in the obstacle, and so does the ball in the cube, of radius w/2, with its middle at most s = √¾ w from p. If no
direction is farther than δ from a beam, one of them hits that ball as soon as sin δ <= (w/2) / (d + s), and returns
from d + s at the most. The smallest such edge is w = κ d with κ = 2 sin δ / (1 - √3 sin δ). So a patch is free up to

    F = min( ρ / (1 + √¾ κ),  W / κ )

with ρ the least range of all beams within `asin(√¾ κ) + δ` of any direction in it. Patches are as wide as beams are
apart, so δ is half the diagonal of the grid's meshes. A ball twice as wide covers all four beams of some mesh: that is
what counts where single beams say nothing, or are doubted. Where a mesh has too few that say something, nothing is
known. And a beam that returns from where no mesh about it returns as a whole, where one would have to, is a ghost.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache, cached_property, lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from brakeline.messaging.range_image import RangeImage

Array = NDArray[np.float64]
Single = NDArray[np.float32]

SINGLE = 1e-6  # of a range: more than a few operations in single precision are off by
CORNER = math.sqrt(0.75)  # of a cube's edge: from its corner to its middle


@dataclass(frozen=True)
class SphereCover:
    """Of beams that no direction is farther from than so much: kappa, and `within` [rad] of a direction in a patch
    are the beams that say how far the patch is free."""

    kappa: float
    within: float

    @staticmethod
    def of(farthest: float, patch: float) -> SphereCover:
        """farthest [rad]: of any direction from a beam; patch [rad]: of a direction in a patch from its beam."""
        sine = math.sin(farthest)
        kappa = 2.0 * sine / (1.0 - math.sqrt(3.0) * sine)
        return SphereCover(kappa, patch + math.asin(min(CORNER * kappa, 1.0)) + farthest)

    @property
    def share(self) -> float:
        """Of the range that what covers a point returns from: from where it can be hit at the nearest."""
        return 1.0 / (1.0 + CORNER * self.kappa)

    def free(self, least: Single, least_width: float) -> Single:
        """F [m] by the least ranges [m], which it overwrites."""
        from brakeline.safety.perception.kernels.proximity_kernels import scale_to  # compiled

        scale_to(least, *self.scale(least_width))
        return least

    def scale(self, least_width: float) -> tuple[float, float]:
        """What F is of the least range, and how much [m] at the most."""
        return (1.0 - SINGLE) * self.share, (1.0 - SINGLE) * least_width / self.kappa


@cache
def _free_of_single() -> Callable[..., tuple[Single, Single]]:
    from brakeline.safety.perception.kernels.proximity_kernels import free_of_single  # compiled

    return free_of_single


def patch_free_ranges(image: RangeImage) -> tuple[BeamGrid, Single]:
    """The grid, from pole to pole, and F (E', A) [m] of each beam's patch."""
    width, grid = image.least_width, BeamGrid.of(*image.ranges.shape, image.low, image.high)
    ranges, scale = np.ascontiguousarray(image.ranges), grid.single.scale(width)
    errors = image.far, image.range_error
    returns, free = _free_of_single()(ranges, *grid.rings, *errors, *grid.windows, *scale, image.doubt)
    if free.size:
        return grid, free
    known, nothing = returns >= 0.0, np.float32(0.0)
    enough = meshes(np.add, known.astype(np.int8)) > image.doubt
    # Who says nothing does not say that something is near, either.
    silent = np.where(known, returns, np.float32(np.inf))
    free = grid.double.free(grid.balls.least(np.where(enough, silent, nothing)), width)
    if not image.doubt:
        free = np.maximum(free, grid.single.free(grid.beams.least(np.maximum(returns, nothing)), width))
    return grid, free


def meshes(of: np.ufunc, values: NDArray[Any]) -> NDArray[Any]:
    """Of each beam and its neighbours to the left, above and above to the left (E, A); of the last ring, of two."""
    found = of(values, np.roll(values, -1, axis=1))
    found[:-1] = of(found[:-1], found[1:])
    return np.asarray(found)


@dataclass(frozen=True)
class GridWindow:
    """So many rings above and below a beam, and so many columns (E,) beside it by its ring."""

    rows: int
    beside: NDArray[np.int64]

    @staticmethod
    def of(columns: int, elevations: Array, step: float, within: float) -> GridWindow:
        """A box about all beams within so many rad of each on the sphere."""
        half = np.full(len(elevations), math.pi)  # a cap with a pole in it is all about
        level = np.abs(elevations) + within < 0.5 * math.pi
        half[level] = np.arcsin(np.minimum(math.sin(within) / np.cos(elevations[level]), 1.0))
        beside = np.minimum(np.ceil(half * columns / math.tau - 1e-9), columns).astype(np.int64)
        return GridWindow(math.ceil(within / step - 1e-9), beside)

    def least(self, values: Single) -> Single:
        """The least (E, A) of each beam's window in a grid (E, A)."""
        from brakeline.safety.perception.kernels.proximity_kernels import least_of  # compiled

        return least_of(np.ascontiguousarray(values, np.float32), self.rows, self.beside)


@dataclass(frozen=True, eq=False)
class BeamGrid:
    """What is known of a grid before any range: elevations (E',) [rad] from pole to pole, of which so many rings below
    and above are not seen, columns, and how far no direction is from the nearest beam [rad]; what single beams say and
    where they are, and balls twice as wide."""

    elevations: Array
    columns: int
    half_diagonal: float
    below: int
    above: int
    single: SphereCover
    beams: GridWindow
    double: SphereCover
    balls: GridWindow

    @cached_property
    def rings(self) -> tuple[int, int]:
        """That are not seen, below and above."""
        return self.below, self.above

    @cached_property
    def windows(self) -> tuple[float, int, NDArray[np.int64], int, NDArray[np.int64]]:
        """Of balls twice as wide: of a mesh's range the share that they return from; theirs and single beams'."""
        return self.double.share, self.balls.rows, self.balls.beside, self.beams.rows, self.beams.beside

    @staticmethod
    @lru_cache(maxsize=64)
    def of(rings: int, columns: int, low: float, high: float) -> BeamGrid:
        step = (high - low) / (rings - 1)
        patch = 0.5 * math.hypot(step, math.tau / columns)
        above, below = (max(math.ceil((0.5 * math.pi - end) / step - 0.5 - 1e-9), 0) for end in (high, -low))
        elevations = np.clip(low + step * np.arange(-below, rings + above), -0.5 * math.pi, 0.5 * math.pi)
        single, double = (
            SphereCover.of(patch, patch),
            SphereCover.of(max(2.0 * patch, 1.5 * step), patch),
        )  # the latter at a pole
        beams, balls = (GridWindow.of(columns, elevations, step, cover.within) for cover in (single, double))
        return BeamGrid(elevations, columns, patch, below, above, single, beams, double, balls)

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
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from messaging.range_images import RangeImage

Array = NDArray[np.float64]

CORNER = math.sqrt(0.75)  # of a cube's edge: from its corner to its middle


@dataclass(frozen=True)
class Cover:
    """Of beams that no direction is farther from than so much: kappa, and `within` [rad] of a direction in a patch
    are the beams that say how far the patch is free."""

    kappa: float
    within: float

    @staticmethod
    def of(farthest: float, patch: float) -> Cover:
        """farthest [rad]: of any direction from a beam; patch [rad]: of a direction in a patch from its beam."""
        sine = math.sin(farthest)
        kappa = 2.0 * sine / (1.0 - math.sqrt(3.0) * sine)
        return Cover(kappa, patch + math.asin(min(CORNER * kappa, 1.0)) + farthest)

    def farthest(self, returns: Array, error: float) -> Array:
        """m, from where a point can be hit at the nearest if what covers it returns from so far."""
        return np.asarray((returns - error) / (1.0 + CORNER * self.kappa))

    def free(self, least: Array, least_width: float) -> Array:
        """F [m] by the least ranges [m]."""
        return np.minimum(least / (1.0 + CORNER * self.kappa), least_width / self.kappa)


def half_diagonal(image: RangeImage) -> float:
    """[rad]: no direction is farther from the grid's nearest beam."""
    return 0.5 * math.hypot(*image.step)


def seen_free(image: RangeImage) -> tuple[Array, Array]:
    """The rings' elevations (E',), from pole to pole, and F (E', A) [m] of each beam's patch."""
    elevations, above, below = _rings(len(image.ranges), image.low, image.high)
    step, patch = image.step[0], half_diagonal(image)
    single, double = Cover.of(patch, patch), Cover.of(max(2.0 * patch, 1.5 * step), patch)  # the latter at a pole
    ranges = np.maximum(np.minimum(image.ranges, image.far) - image.range_error, 0.0)
    known = image.ranges > 0.0
    if below or above:
        ranges, known = (np.pad(part, ((below, above), (0, 0))) for part in (ranges, known))
    returns = meshes(np.maximum, np.where(known, ranges, 0.0))  # the farthest return of each mesh
    possible = double.farthest(least_within(returns, elevations, step, double.within), 2.0 * image.range_error)
    known &= ranges >= possible
    if known.all() and not image.doubt:
        return elevations, single.free(least_within(ranges, elevations, step, single.within), image.least_width)
    enough = meshes(np.add, known.astype(np.int8)) > image.doubt
    heard = np.where(known, ranges, np.inf)  # what says nothing does not say that something is near, either
    free = double.free(least_within(np.where(enough, heard, 0.0), elevations, step, double.within), image.least_width)
    if not image.doubt:
        whole = least_within(np.where(known, ranges, 0.0), elevations, step, single.within)
        free = np.maximum(free, single.free(whole, image.least_width))
    return elevations, np.asarray(free)


def meshes(of: np.ufunc, values: NDArray[Any]) -> NDArray[Any]:
    """Of each beam and its neighbours to the left, above and above to the left (E, A); of the last ring, of two."""
    found = of(values, np.roll(values, -1, axis=1))
    found[:-1] = of(found[:-1], found[1:])
    return np.asarray(found)


@lru_cache(maxsize=64)
def _rings(rings: int, low: float, high: float) -> tuple[Array, int, int]:
    """Elevations from pole to pole, and how many rings above and below are not seen."""
    step = (high - low) / (rings - 1)
    above, below = (max(math.ceil((0.5 * math.pi - end) / step - 0.5 - 1e-9), 0) for end in (high, -low))
    elevations = low + step * np.arange(-below, rings + above)
    return np.clip(elevations, -0.5 * math.pi, 0.5 * math.pi), above, below


def least_within(values: Array, elevations: Array, step: float, within: float) -> Array:
    """The least (E, A) of all that are within so many rad of each on the sphere: of a box about that cap."""
    from messaging.nearby import least_of  # compiled

    rows = math.ceil(within / step - 1e-9)
    return least_of(np.ascontiguousarray(values), rows, _beside(values.shape[1], tuple(elevations), within))


@lru_cache(maxsize=64)
def _beside(columns: int, elevations: tuple[float, ...], within: float) -> NDArray[np.int64]:
    """(E,): how many columns beside a beam of each ring `least_within` looks at."""
    half = np.full(len(elevations), math.pi)  # a cap with a pole in it is all about
    for i, elevation in enumerate(elevations):
        if abs(elevation) + within < 0.5 * math.pi:
            half[i] = math.asin(math.sin(within) / math.cos(elevation))
    return np.minimum(np.ceil(half * columns / math.tau - 1e-9), columns).astype(np.int64)

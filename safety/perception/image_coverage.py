"""How far a range image shows each patch of directions to be free (docs/method.md §10).

Take a point of an obstacle at distance d from the sensor. By assumption it is the corner of a cube that lies in the
obstacle, for any edge w up to the least width W. The cube's inner ball of radius w/2 has its center at most s = √¾ w
from the point. If no direction is farther than δ from a beam, some beam hits that ball as soon as
sin δ ≤ (w/2) / (d + s), and returns a range of at most d + s. The smallest such edge is w = κ d with
κ = 2 sin δ / (1 - √3 sin δ). So a patch is free up to

    F = min( ρ / (1 + √¾ κ),  W / κ ),

with ρ the least range of all beams within asin(√¾ κ) + δ of any direction in the patch. Patches are as wide as beams
are apart, so δ is half the diagonal of a mesh (the cell between four neighbouring beams).

If a beam is unknown or single beams are doubted, a ball twice as wide counts: it covers all four beams of some mesh. A
mesh with too few known beams shows nothing to be free. A *ghost* is a return that is nearer than an obstacle can be, by
the meshes around it; it counts as unknown.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache, lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from brakeline.messaging.range_image import Array, RangeImage

Single = NDArray[np.float32]

SINGLE = 1e-6  # relative error of a few operations in single precision, at most
CORNER = math.sqrt(0.75)  # from a cube's corner to its center, per metre of edge


@dataclass(frozen=True)
class SphereCover:
    """Beams that no direction on the sphere is farther from than an angle δ."""

    kappa: float  # κ, the edge of the cube that a beam cannot miss, per metre of distance
    within: float  # angle [rad] around a patch's beam within which the beams bound the patch's free range

    @staticmethod
    def of(delta: float, patch: float) -> SphereCover:
        """Make a cover. delta [rad]: from any direction to a beam; patch [rad]: from a patch's edge to its beam."""
        sine = math.sin(delta)
        kappa = 2.0 * sine / (1.0 - math.sqrt(3.0) * sine)
        return SphereCover(kappa, patch + math.asin(min(CORNER * kappa, 1.0)) + delta)

    @property
    def share(self) -> float:
        """The distance of a point per metre of the range that its cube returns, at least."""
        return 1.0 / (1.0 + CORNER * self.kappa)

    def scale(self, least_width: float) -> tuple[float, float]:
        """Return F per metre of the least range, and the largest F [m]."""
        return (1.0 - SINGLE) * self.share, (1.0 - SINGLE) * least_width / self.kappa

    def free(self, least: Single, least_width: float) -> Single:
        """Return F [m] for the least ranges [m], which it overwrites."""
        from brakeline.safety.perception.kernels.proximity_kernels import scale_to  # compiled

        scale_to(least, *self.scale(least_width))
        return least


@cache
def _single_beam_ranges() -> Callable[..., tuple[Single, Single]]:
    from brakeline.safety.perception.kernels.proximity_kernels import single_beam_ranges  # compiled

    return single_beam_ranges


def patch_free_ranges(image: RangeImage) -> tuple[BeamGrid, Single]:
    """Return the grid from pole to pole, and the free range F (E', A) [m] of each beam's patch."""
    width, grid = image.least_width, BeamGrid.of(*image.ranges.shape, image.low, image.high)
    ranges, sensor = np.ascontiguousarray(image.ranges), (float(image.far), float(image.range_error), image.doubt)
    mesh_window = grid.double.share, grid.mesh_window.rows, grid.mesh_window.beside
    beam_window = grid.beam_window.rows, grid.beam_window.beside
    returns, free = _single_beam_ranges()(
        ranges, grid.added, sensor, mesh_window, beam_window, grid.single.scale(width)
    )
    if free.size:
        return grid, free
    known, zero = returns >= 0.0, np.float32(0.0)
    enough = by_mesh(np.add, known.astype(np.int8)) > image.doubt
    known_or_far = np.where(known, returns, np.float32(np.inf))  # an unknown beam does not say that something is near
    free = grid.double.free(grid.mesh_window.minimum(np.where(enough, known_or_far, zero)), width)
    if not image.doubt:
        free = np.maximum(free, grid.single.free(grid.beam_window.minimum(np.maximum(returns, zero)), width))
    return grid, free


def has_blind_directions(image: RangeImage) -> bool:
    """Return whether an image has directions without information, or with something that touches the sensor."""
    return bool((patch_free_ranges(image)[1] <= 0.0).any())


def unseen_poles(image: RangeImage) -> str:
    """Return what an image without beams up or down lacks, and what to do; empty if its rings reach both poles.

    A body that flies then touches unknown space, and no earlier image shows what is above and below it.
    """
    below, above = BeamGrid.of(*image.ranges.shape, image.low, image.high).added
    sides = [f"above {math.degrees(image.high):.0f}°"] if above else []
    sides += [f"below {math.degrees(image.low):.0f}°"] if below else []
    if not sides or not has_blind_directions(replace(image, ranges=np.full_like(image.ranges, image.far))):
        return ""
    return (
        f"the range image has no beams {' and '.join(sides)}, so all space there counts as occupied, up to the body: "
        "give an image whose rings reach from -90° to 90°, or obstacles from a map and no image"
    )


def by_mesh(of: np.ufunc, values: NDArray[Any]) -> NDArray[Any]:
    """Combine the values (E, A) of each beam, its left neighbour and the two above them; in the last ring, of two."""
    meshes = of(values, np.roll(values, -1, axis=1))
    meshes[:-1] = of(meshes[:-1], meshes[1:])
    return np.asarray(meshes)


@dataclass(frozen=True)
class GridWindow:
    """Neighbours of each beam in a grid."""

    rows: int  # rings above and below the beam
    beside: NDArray[np.int64]  # (E,) columns to the left and to the right of the beam, by its ring

    @staticmethod
    def of(columns: int, elevations: Array, step: float, within: float) -> GridWindow:
        """Return a window that holds all beams within an angle [rad] on the sphere; step [rad]: between rings."""
        half = np.full(len(elevations), math.pi)  # a cap around a pole has all azimuths
        level = np.abs(elevations) + within < 0.5 * math.pi
        half[level] = np.arcsin(np.minimum(math.sin(within) / np.cos(elevations[level]), 1.0))
        beside = np.minimum(np.ceil(half * columns / math.tau - 1e-9), columns).astype(np.int64)
        return GridWindow(math.ceil(within / step - 1e-9), beside)

    def minimum(self, values: Single) -> Single:
        """Return the minimum (E, A) of each beam's window in a grid (E, A)."""
        from brakeline.safety.perception.kernels.proximity_kernels import window_minimum  # compiled

        return window_minimum(np.ascontiguousarray(values, np.float32), self.rows, self.beside)


@dataclass(frozen=True, eq=False)
class BeamGrid:
    """The geometry of a grid of beams, which its ranges do not change."""

    elevations: Array  # (E',) [rad] from pole to pole
    columns: int  # A
    half_diagonal: float  # largest angle [rad] from any direction to the nearest beam
    added: tuple[int, int]  # the numbers of rings (below, above) that the sensor does not see
    # single, beam_window: the cover by single beams, and the beams that bound a patch's free range
    single: SphereCover
    beam_window: GridWindow
    # double, mesh_window: the same for meshes
    double: SphereCover
    mesh_window: GridWindow

    @staticmethod
    @lru_cache(maxsize=64)
    def of(rings: int, columns: int, low: float, high: float) -> BeamGrid:
        """Return the geometry of a grid whose rings lie between two elevations [rad]."""
        step = (high - low) / (rings - 1)
        patch = 0.5 * math.hypot(step, math.tau / columns)
        below, above = (max(math.ceil((0.5 * math.pi - end) / step - 0.5 - 1e-9), 0) for end in (-low, high))
        elevations = np.clip(low + step * np.arange(-below, rings + above), -0.5 * math.pi, 0.5 * math.pi)
        single = SphereCover.of(patch, patch)
        double = SphereCover.of(max(2.0 * patch, 1.5 * step), patch)  # 1.5 steps: at a pole
        beams, meshes = (GridWindow.of(columns, elevations, step, cover.within) for cover in (single, double))
        return BeamGrid(elevations, columns, patch, (below, above), single, beams, double, meshes)

"""Memory of free space: fills in the beams of a scan that measured nothing (docs/method.md §10).

The client keeps the memory, because the service keeps nothing about a robot. In a world that moves (`Scan.speed`), free
space in the memory shrinks with time. A ring of `START` m around the body counts as free at the start: without it, a
robot with a blind sector could never move, because its body would touch occupied space.
"""

from __future__ import annotations

import copy
import math
from abc import ABC, abstractmethod
from collections import deque
from dataclasses import dataclass, replace
from typing import Generic, TypeVar

import numpy as np
from numpy.typing import NDArray

from brakeline.errors import BadRequest
from brakeline.messaging.obstacle import FARTHEST, Array
from brakeline.messaging.range_image import RangeImage
from brakeline.messaging.scan import MAX_BEAMS, Scan
from brakeline.safety.perception.occlusion_exits import minimum_by_sector
from brakeline.safety.perception.scan_coverage import WIDE, gaps
from brakeline.safety.perception.scan_tracking import ScanTracker

CAPACITY = 12  # scans
SPACING = 0.04  # m, or a quarter of it in rad: smallest motion between two stored scans
REACH = 1.0  # m along a beam that the memory is asked about
STEP = 0.01  # m between the tested points of a beam
SECTORS = 360  # of a turn
LEFT_OUT = math.radians(15.0)  # between two beams: in a wider gap, the memory adds beams
VERY_OLD = FARTHEST  # s: the largest age that a scan can have


S = TypeVar("S", Scan, RangeImage)


class VisibilityMemory(ABC, Generic[S]):
    """The free space that one robot's sensor has shown in one episode.

    Poses are measured ones, with their errors. The bounds hold as long as the world is not reset.
    """

    START = 0.1  # width [m] of the ring around the body that counts as free at the start
    nothing: S  # a scan that shows nothing to be free

    def __init__(self, footprint: float) -> None:
        """Begin an episode. footprint: radius of the body's disc or ball [m]."""
        self._start_radius = footprint + self.START
        self._used = False
        self.reset()

    def reset(self) -> None:
        """Forget all space: an episode begins."""
        self._begun = False
        self._first: S | None = None
        self._last: S | None = None  # as returned
        self._since_last = 0.0  # s
        self._since_start = 0.0  # s
        self._ages: list[float] = []  # s, of the stored scans

    def later(self, elapsed: float) -> None:
        """Let time pass [s].

        Raises:
            BadRequest: the time is negative or not finite. The memory then takes everything in it as too old.
        """
        if not 0.0 <= elapsed < math.inf:  # NaN fails too
            self._lose_time()
            raise BadRequest("elapsed", f"elapsed is {elapsed:g} s: give the time since the last call, 0 or more")
        self._since_last += elapsed
        self._since_start += elapsed
        self._ages = [age + elapsed for age in self._ages]

    def _lose_time(self) -> None:
        """Take everything in memory as very old, because the time since the last call is unknown."""
        self._since_last = self._since_start = VERY_OLD
        self._ages = [VERY_OLD] * len(self._ages)

    @property
    def unused(self) -> bool:
        """Whether no scan has ever come, in no episode."""
        return not self._used

    def fill(self, scan: S | None, elapsed: float) -> S:
        """Return the scan with unknown beams filled in from memory.

        Args:
            scan: the new scan. None if none came: the last one stays valid and ages, and before the first one nothing
                is free.
            elapsed: time since the last call [s].

        Raises:
            BadRequest: `elapsed` is negative or not finite.
        """
        if self._begun:
            self.later(elapsed)
        self._begun = True
        if scan is None:
            if self._last is None:
                return _with_own_ranges(self.nothing)
            return _with_own_ranges(replace(self._last, age=min(self._last.age + self._since_last, VERY_OLD)))
        scan, self._used = self._copied(scan), True
        if self._first is None:
            self._first = scan
        unknown = self._beams_to_fill(scan)
        filled = scan
        if unknown.any():
            ranges = np.array(scan.ranges)
            # `_free_along` subtracts the errors already, and every reader of a scan subtracts the range error again.
            free = self._free_along(scan, unknown)
            ranges[unknown] = np.where(free > 0.0, np.minimum(free + scan.range_error, scan.far), 0.0)
            filled = replace(scan, ranges=ranges)
        self._store(scan)
        self._last, self._since_last = filled, 0.0
        return _with_own_ranges(filled)

    @abstractmethod
    def _copied(self, scan: S) -> S:
        """Return the scan with copies of its arrays, which the caller may overwrite."""

    @abstractmethod
    def _beams_to_fill(self, scan: S) -> NDArray[np.bool_]:
        """Return the mask of the beams to fill in, shaped like `ranges`."""

    @abstractmethod
    def _free_along(self, scan: S, beams: NDArray[np.bool_]) -> Array:
        """Return how far [m] the masked beams (B,) are known to be free."""

    @abstractmethod
    def _store(self, scan: S) -> None:
        """Store the scan, unless the sensor has hardly moved since the last stored one."""

    def _near_start(self, points: Array, scan: S, step: Array | float) -> NDArray[np.bool_]:
        """Return which points (..., d) are in the ring that is free at the start; step [m]: between two points."""
        assert self._first is not None
        moved = scan is not self._first
        drift = (self._first.position_error + scan.position_error) * moved + scan.speed * self._since_start + step
        return np.asarray(np.linalg.norm(points - _position(self._first), axis=-1) <= self._start_radius - drift)


def _with_own_ranges(scan: S) -> S:
    """Return a scan with ranges of its own, which the caller may overwrite; their values need no second check."""
    other = copy.copy(scan)
    object.__setattr__(other, "ranges", scan.ranges.copy())
    return other


def _position(scan: Scan | RangeImage) -> Array:
    """Return the robot's measured position (d,) [m]."""
    return np.asarray(scan.pose[:2] if isinstance(scan, Scan) else scan.at)


@dataclass(frozen=True)
class _StoredScan:
    """A scan as free ranges by direction."""

    scan: Scan
    # at, heading: pose of the sensor
    at: Array
    heading: float
    minima: Array  # (levels, SECTORS) minima[k, i] is the least free range [m] of the 2^k sectors from sector i on


class FanMemory(VisibilityMemory[Scan]):
    """Memory of a sensor whose beams fan out in the plane."""

    nothing = Scan(np.zeros(0), np.zeros(0), (0.0, 0.0, 0.0))

    def __init__(self, footprint: float, longest: float = math.inf) -> None:
        """longest: age [s] from which on a stored scan no longer counts. If it is finite, every scan is stored."""
        self._longest = longest
        super().__init__(footprint)

    def reset(self) -> None:
        super().reset()
        self._stored: deque[_StoredScan] = deque(maxlen=CAPACITY)
        self._tracker = ScanTracker()

    def later(self, elapsed: float) -> None:
        super().later(elapsed)
        self._tracker.later(elapsed)
        while self._ages and self._ages[0] > self._longest:
            self._stored.popleft()
            self._ages = self._ages[1:]

    def _lose_time(self) -> None:
        super()._lose_time()
        self._tracker.reset()  # a longer time would make motions look slower

    def fill(self, scan: Scan | None, elapsed: float) -> Scan:
        """Fill in the scan, also where it has no beams, and add the motions that `ScanTracker` knows."""
        scan = None if scan is None else _whole_turn(scan)
        filled = super().fill(scan, elapsed)
        if scan is None:
            return filled
        tracks = self._tracker.follow(scan).tracks
        if tracks is not None and self._last is not None:
            self._last, filled = replace(self._last, tracks=tracks), replace(filled, tracks=tracks)
        return filled

    def _copied(self, scan: Scan) -> Scan:
        return replace(scan, ranges=scan.ranges.copy(), angles=scan.angles.copy())

    def _beams_to_fill(self, scan: Scan) -> NDArray[np.bool_]:
        return ~scan.valid_beams

    def _store(self, scan: Scan) -> None:
        if self._stored and self._longest == math.inf:
            last = self._stored[-1].scan.pose
            moved = math.dist(last[:2], scan.pose[:2]) + 0.25 * abs(math.remainder(scan.pose[2] - last[2], math.tau))
            if moved < SPACING:
                return
        self._stored.append(self._as_stored(scan))
        self._ages = [*self._ages, scan.age][-CAPACITY:]

    @staticmethod
    def _as_stored(scan: Scan) -> _StoredScan:
        return _StoredScan(scan, *scan.sensor(), _range_minima(minimum_by_sector(*gaps(scan), SECTORS)))

    def _free_along(self, scan: Scan, beams: NDArray[np.bool_]) -> Array:
        at, heading = scan.sensor()
        away = STEP * np.arange(1, round(REACH / STEP) + 1)
        turned = heading + scan.angles[beams]
        points = at + away[:, None, None] * np.stack([np.cos(turned), np.sin(turned)], axis=1)  # (S, B, 2)
        free = self._near_start(points, scan, STEP)
        for stored, age in zip(self._stored, self._ages, strict=True):
            free |= self._shown_free(stored, age, points, scan)
        return STEP * np.where(free.all(axis=0), len(away), free.argmin(axis=0))

    @staticmethod
    def _shown_free(
        stored: _StoredScan, age: float, points: Array, scan: Scan, spacing: float = STEP
    ) -> NDArray[np.bool_]:
        """Return which points a stored scan shows to be free, with all within the errors and `spacing` around."""
        away = points - stored.at
        far = np.sqrt(np.einsum("sbd,sbd->sb", away, away))
        drift = stored.scan.sensor_error + scan.position_error + scan.speed * age + spacing
        reach = np.linalg.norm(points - _position(scan), axis=-1)
        drift = drift + stored.scan.heading_error * far + scan.heading_error * reach
        aside = np.arcsin(np.minimum(drift / np.maximum(far, 1e-9), 1.0))
        angle = np.arctan2(away[..., 1], away[..., 0]) - stored.heading
        first = np.floor((angle - aside) * (SECTORS / math.tau)).astype(int)
        last = np.floor((angle + aside) * (SECTORS / math.tau)).astype(int)
        count = np.where(drift >= far, SECTORS, np.minimum(last - first + 1, SECTORS))
        level = np.floor(np.log2(count)).astype(int)
        low = stored.minima[level, first % SECTORS]
        high = stored.minima[level, (first + count - (1 << level)) % SECTORS]
        return np.asarray(far + drift < np.minimum(low, high))


def _whole_turn(scan: Scan) -> Scan:
    """Return the scan with beams without information where it has no beams, as behind a sensor of 270°."""
    if not len(scan.angles) or scan.tracks is not None:
        return scan
    gap = np.diff(scan.angles, append=scan.angles[0] + math.tau)
    parts = np.where(gap > LEFT_OUT, np.ceil(gap / WIDE), 1.0).astype(int)
    if not len(scan.angles) < parts.sum() <= MAX_BEAMS:
        return scan
    beam = np.repeat(np.arange(len(gap)), parts)
    number = np.arange(len(beam)) - np.repeat(np.cumsum(parts) - parts, parts)
    angles = scan.angles[beam] + number * (gap / parts)[beam]
    return replace(scan, ranges=np.where(number == 0, scan.ranges[beam], 0.0), angles=angles)


def _range_minima(least: Array) -> Array:
    """Return a sparse table (levels, SECTORS): row k holds the minimum of 2^k values from each on, around the turn."""
    rows = [least]
    while 1 << len(rows) <= SECTORS:
        half = 1 << (len(rows) - 1)
        rows.append(np.minimum(rows[-1], np.roll(rows[-1], -half)))
    return np.stack(rows)

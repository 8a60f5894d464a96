"""What a robot's sensor saw free before: fills in the beams of a scan that say nothing (docs/method.md §10).

The asker keeps it: the service keeps nothing about a robot. A world that moves (`Scan.speed`) takes back with time what
was seen. Where the robot was put there is room: `START` m about its body; without that it could never move away from a
blind sector, for it would touch it already.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections import deque
from dataclasses import dataclass, replace
from typing import Generic, TypeVar

import numpy as np
from numpy.typing import NDArray

from brakeline.messaging.range_image import RangeImage
from brakeline.messaging.scan import Scan
from brakeline.safety.perception.occlusion_exits import least_of
from brakeline.safety.perception.scan_free_space import gaps
from brakeline.safety.perception.scan_tracking import ScanTracker

Array = NDArray[np.float64]

KEPT = 12  # scans
APART = 0.04  # m or, by a quarter of it, rad, between two that are kept
LOOK = 1.0  # m along a beam that memory is asked about
STEP = 0.01  # m between the places at which it is
CELLS = 360  # of a turn


S = TypeVar("S", Scan, RangeImage)


class VisibilityMemory(ABC, Generic[S]):
    """Of one robot in one world that is not put back. Positions are the measured ones, with their errors."""

    START = 0.1  # m beside the body, where it is put down
    nothing: S  # a scan that shows nothing to be free

    def __init__(self, footprint: float) -> None:
        """footprint: radius of the body's disc or ball, m."""
        self._room = footprint + self.START
        self.reset()

    def reset(self) -> None:
        """It is put down somewhere else."""
        self._begun = False
        self._put: S | None = None
        self._last: S | None = None  # as it was given out
        self._waited = 0.0  # s since then
        self._age = 0.0  # s since it was put down
        self._before: list[float] = []  # s since each that is kept was taken

    def later(self, elapsed: float) -> None:
        """So many s go by."""
        self._waited += elapsed
        self._age += elapsed
        self._before = [age + elapsed for age in self._before]

    @property
    def unused(self) -> bool:
        """Has no scan been given to it?"""
        return self._last is None

    def fill(self, scan: S | None, elapsed: float) -> S:
        """The scan, with what is remembered in the place of beams that say nothing; elapsed: s since the last one.

        None: none came. Then the last one goes on to be what is known, so much older; before the first nothing is.
        """
        if self._begun:
            self.later(elapsed)
        self._begun = True
        if scan is None:
            return self.nothing if self._last is None else replace(self._last, age=self._last.age + self._waited)
        scan = self._own(scan)
        if self._put is None:
            self._put = scan
        unknown = self._wanted(scan)
        filled = scan
        if unknown.any():
            ranges = np.array(scan.ranges)
            # What is remembered has its errors off already; whoever reads a scan takes them off every beam.
            known = self._along(scan, unknown)
            ranges[unknown] = np.where(known > 0.0, np.minimum(known + scan.range_error, scan.far), 0.0)
            filled = replace(scan, ranges=ranges)
        self._keep(scan)
        self._last, self._waited = filled, 0.0
        return filled

    @abstractmethod
    def _own(self, scan: S) -> S:
        """With arrays of its own: whoever asks may fill his again."""

    @abstractmethod
    def _wanted(self, scan: S) -> NDArray[np.bool_]:
        """The beams to be filled in, as `ranges`."""

    @abstractmethod
    def _along(self, scan: S, beams: NDArray[np.bool_]) -> Array:
        """How far these beams (B,) are known to be free, m; 0: not at all."""

    @abstractmethod
    def _keep(self, scan: S) -> None:
        """Remember it, if it was taken from somewhere else than the last one that is kept."""

    def _at_start(self, points: Array, scan: S, step: Array | float) -> NDArray[np.bool_]:
        """In the room that it was put down in? step [m]: from each of the points (..., d) to the next."""
        assert self._put is not None
        moved = scan is not self._put
        drift = 2.0 * scan.position_error * moved + scan.speed * self._age + step
        return np.asarray(np.linalg.norm(points - _place(self._put), axis=-1) <= self._room - drift)


def _place(scan: Scan | RangeImage) -> Array:
    """(d,): the robot's measured position when it was taken."""
    return np.asarray(scan.pose[:2] if isinstance(scan, Scan) else scan.at)


@dataclass(frozen=True)
class _Seen:
    """A scan as the free range of every direction: least[k] (CELLS,) over 2^k of them from each on."""

    scan: Scan
    at: Array
    heading: float
    least: list[Array]


class FanMemory(VisibilityMemory[Scan]):
    """Of a fan in the plane."""

    nothing = Scan(np.zeros(0), np.zeros(0), (0.0, 0.0, 0.0))

    def reset(self) -> None:
        super().reset()
        self._seen: deque[_Seen] = deque(maxlen=KEPT)
        self._follower = ScanTracker()

    def later(self, elapsed: float) -> None:
        super().later(elapsed)
        self._follower.later(elapsed)

    def fill(self, scan: Scan | None, elapsed: float) -> Scan:
        """The same; where it is known how things speed up, what earlier scans say of where they go comes with it."""
        filled = super().fill(scan, elapsed)
        if scan is None:
            return filled
        followed = self._follower.follow(scan).tracks
        if followed is not None:
            self._last = filled = replace(filled, tracks=followed)
        return filled

    def _own(self, scan: Scan) -> Scan:
        return replace(scan, ranges=scan.ranges.copy(), angles=scan.angles.copy())

    def _wanted(self, scan: Scan) -> NDArray[np.bool_]:
        return ~scan.known

    def _keep(self, scan: Scan) -> None:
        if self._seen:
            last = self._seen[-1].scan.pose
            moved = math.dist(last[:2], scan.pose[:2]) + 0.25 * abs(math.remainder(scan.pose[2] - last[2], math.tau))
            if moved < APART:
                return
        if len(self._seen) == KEPT:
            self._before.pop(0)
        at, heading = scan.sensor()
        self._seen.append(_Seen(scan, at, heading, _levels(_least(scan))))
        self._before.append(scan.age)

    def _along(self, scan: Scan, beams: NDArray[np.bool_]) -> Array:
        at, heading = scan.sensor()
        away = STEP * np.arange(1, round(LOOK / STEP) + 1)
        turned = heading + scan.angles[beams]
        points = at + away[:, None, None] * np.stack([np.cos(turned), np.sin(turned)], axis=1)  # (S, B, 2)
        free = self._at_start(points, scan, STEP)
        for seen, age in zip(self._seen, self._before, strict=True):
            free |= self._in(seen, age, points, scan)
        return STEP * np.where(free.all(axis=0), len(away), free.argmin(axis=0))

    def _in(self, seen: _Seen, age: float, points: Array, scan: Scan) -> NDArray[np.bool_]:
        """Was it seen free, with all that is within the errors since?"""
        away = points - seen.at
        far = np.sqrt(np.einsum("sbd,sbd->sb", away, away))
        drift = seen.scan.sensor_error + scan.position_error + scan.speed * age + STEP
        reach = np.linalg.norm(points - _place(scan), axis=-1)
        drift = drift + seen.scan.heading_error * far + scan.heading_error * reach
        aside = np.arcsin(np.minimum(drift / np.maximum(far, 1e-9), 1.0))
        angle = np.arctan2(away[..., 1], away[..., 0]) - seen.heading
        first = np.floor((angle - aside) * (CELLS / math.tau)).astype(int)
        last = np.floor((angle + aside) * (CELLS / math.tau)).astype(int)
        count = np.where(drift >= far, CELLS, np.minimum(last - first + 1, CELLS))
        level = np.floor(np.log2(count)).astype(int)
        table = np.stack(seen.least)
        low = table[level, first % CELLS]
        high = table[level, (first + count - (1 << level)) % CELLS]
        return np.asarray(far + drift < np.minimum(low, high))


def _least(scan: Scan) -> Array:
    """The least free range (CELLS,) of the gaps that meet each of so many equal parts of a turn, from heading 0 on."""
    return least_of(*gaps(scan), CELLS)


def _levels(least: Array) -> list[Array]:
    """least[k][i]: the least of 2^k values from i on, round the turn."""
    found = [least]
    while 1 << len(found) <= CELLS:
        half = 1 << (len(found) - 1)
        found.append(np.minimum(found[-1], np.roll(found[-1], -half)))
    return found
